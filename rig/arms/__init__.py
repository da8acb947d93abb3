"""Robot arms: one small interface, and the arms behind it."""

from rig.arms.arm import Arm, ArmState

__all__ = ["Arm", "ArmState"]
