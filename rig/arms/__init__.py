"""Robot arms: one small interface, and the arms behind it."""

from rig.arms.arm import Arm, ArmState, Safety

__all__ = ["Arm", "ArmState", "Safety"]
