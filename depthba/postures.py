"""The joints with which an arm of the UR kind takes a pose, found from good starts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from depthba.kinematics import DhArm

Array = NDArray[np.float64]

STARTS = (
    (-3.5, -1.58, 1.42, -1.41, -1.57, 0.0),
    (0.36, -1.56, -1.42, -1.73, 1.57, 0.0),
    (-3.5, -1.01, 0.65, 1.94, 1.57, 0.0),
    (0.36, -2.13, -0.65, 1.20, -1.57, 0.0),
)
"""Where the search for joints begins: elbow up, tool down; pan is added to the goal's azimuth."""

SINGULAR = 0.06
"""Least singular value of the Jacobian at a pose; typical is 0.2, at a singularity 0."""

ROOM = 0.1
"""What should stay between a joint and its limits, rad."""


def postures(
    arm: DhArm,
    T_base_flange: Array,
    last: Array | None = None,
    tolerance: float = 1e-10,
    steps: int = 25,
) -> tuple[Array, NDArray[np.bool_]]:
    """Joints (m, k, n) from k starts for each pose (m, 4, 4), and which (m, k) are right.

    Args:
        arm: of six joints, as Universal Robots builds them.
        T_base_flange: (m, 4, 4).
        last: joints (n,) to start from, too.
        tolerance: see `DhArm.solve`.
        steps: see `DhArm.solve`.
    """
    starts = np.repeat(np.array(STARTS)[None], len(T_base_flange), axis=0)
    starts[..., 0] += np.arctan2(T_base_flange[:, 1, 3], T_base_flange[:, 0, 3])[:, None]
    starts[..., 0] = (starts[..., 0] + np.pi) % (2.0 * np.pi) - np.pi
    # The last joint turns about the goal's z: what is left of the rotation about it.
    R_start = arm.forward(starts)[..., :3, :3]
    R = np.swapaxes(R_start, -1, -2) @ T_base_flange[:, None, :3, :3]
    starts[..., -1] = np.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1])
    if last is not None:
        before = np.broadcast_to(last, (len(starts), 1, starts.shape[-1]))
        starts = np.concatenate([before, starts], axis=1)
    return arm.solve(T_base_flange[:, None], starts, tolerance=tolerance, steps=steps)


def turned_towards(q: Array, before: Array) -> Array:
    """Joints (..., n) by full turns as near to `before` (n,) as they come."""
    turn = 2.0 * np.pi
    return np.asarray(q - turn * np.round((q - before) / turn))
