"""Whether the arm runs into the scene, or into itself.

Looked at as rarely as is safe: what is a distance away cannot be met before some point of the arm
has come that far (conservative advancement, Mirtich 1996).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from depthba.kinematics import DhArm
from sim.engine import mujoco
from sim.rigs.clearance import REACH, Clearance
from sim.robots.ur16e import add_ur16e
from sim.scenes import find_scene

Array = NDArray[np.float64]

_FAR = 0.06
"""What is further away is not measured, m."""
_TOUCH = 0.0005
"""What comes closer is met, m."""


class Surroundings:
    """The arm in a scene, as what may collide."""

    def __init__(self, model: mujoco.MjModel, dh: DhArm) -> None:
        """SimulationError if the arm is not in the model."""
        self._clearance = Clearance(model, dh.joints, margin=_FAR)
        self.T_world_base = self._clearance.T_world_base
        self._q: Array | None = None
        self._gap = 0.0

    @classmethod
    def of_scene(cls, scene: str | None, seed: int, dh: DhArm) -> Surroundings:
        """In a scene of `sim.scenes`; None: the bare arm, which can meet only itself."""
        if scene is not None:
            return cls(find_scene(scene).build(seed).compile(), dh)
        spec = mujoco.MjSpec()
        add_ur16e(spec, dh=dh)
        return cls(spec.compile(), dh)

    def met(self, q: Array) -> tuple[str, str] | None:
        """What touches at joints (n,), two names; None: nothing."""
        if self._q is not None and float(np.abs(q - self._q) @ REACH) < self._gap - _TOUCH:
            return None
        distance, names = self._clearance.nearest(q)
        self._q, self._gap = q.copy(), distance
        return names if distance <= _TOUCH else None
