"""What is checked of a target before it leaves for a robot; ArmError names what is wrong."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import se3
from depthba.kinematics import DhArm
from rig.errors import ArmError

Array = NDArray[np.float64]


def checked_joints(target: ArrayLike, dh: DhArm, host: str) -> Array:
    """Joints (n,), rad: as many as the arm has, finite, within its limits."""
    try:
        q = np.array(target, float)
    except (TypeError, ValueError):
        raise ArmError(f"{host}: target {target!r}: expected joints in rad") from None
    if q.shape != (len(dh.joints),):
        raise ArmError(
            f"{host}: target {q.tolist()}: {q.size} numbers, expected {len(dh.joints)} joints"
        )
    if not np.isfinite(q).all():
        raise ArmError(f"{host}: target {q.tolist()}: expected finite joints, rad")
    for name, value, low, high in zip(dh.joints, q, dh.lower, dh.upper, strict=True):
        if not low <= value <= high:
            raise ArmError(
                f"{host}: target {name} {value:.4f} rad: expected {low:.4f} to {high:.4f}"
            )
    return q


def checked_pose(target: ArrayLike, host: str) -> Array:
    """A pose (4, 4): finite and rigid."""
    try:
        T = np.array(target, float)
    except (TypeError, ValueError):
        raise ArmError(f"{host}: target {target!r}: expected a pose (4, 4)") from None
    if T.shape != (4, 4) or not se3.is_rigid(T):
        raise ArmError(f"{host}: target {T.tolist()}: expected a rigid, finite pose (4, 4)")
    return T


def check_rate(name: str, value: float, most: float, unit: str, host: str) -> None:
    """A speed or an acceleration: above 0, at most `most`, which may be infinite."""
    if not (np.isfinite(value) and 0.0 < value <= most):
        limit = f"above 0 and at most {most:g}" if np.isfinite(most) else "above 0"
        raise ArmError(f"{host}: {name} {value}: expected {limit} {unit}")
