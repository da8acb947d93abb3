"""Whether the motions and the depths fix the hand-eye transform, said before any number."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser.certainty import WEAK, direction_name
from rig.hand_eye.depth.believed import Beliefs
from rig.hand_eye.depth.chain import Chain
from rig.hand_eye.depth.fit import Start
from rig.hand_eye.flanges import motion_fault
from rig.hand_eye.record import Open

Array = NDArray[np.float64]

Status = Literal["converged", "not_converged", "weak", "inconsistent", "far"]
"""``converged``: done, to be trusted. ``not_converged``: stopped at a limit. ``weak``: done, but
motions and depths leave a direction open, which was held at the start. ``inconsistent``: flange
poses and frames do not belong together. ``far``: ended farther away than the start may be."""

# A robot that misses by more than this, m and rad, is no robot: the poses are others'.
HOPELESS_T, HOPELESS_R = 0.005, 0.01
# Ending farther from the start than this many of its standard deviations is no coincidence.
FAR = 4.0


def open_directions(covariance: Array, sigma: Array) -> tuple[Open, ...]:
    """Return the directions (6,) whose variance owes more than a share to the start's."""
    values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    found = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value <= WEAK:
            break
        found.append(Open(direction_name(vector), vector * sigma, min(float(value), 1.0)))
    return tuple(found)


def judge(
    chain: Chain, covariance: Array, start: Start, beliefs: Beliefs, ended: str
) -> tuple[Status, str, tuple[Open, ...]]:
    """Return status, reason and what is open; ``ended``: why it did before it settled, or empty."""
    left_open = open_directions(covariance, start.sigma)
    fault = motion_fault(chain.T_base_flange)
    away = np.abs(start.error(chain)) / start.sigma
    if beliefs.robot_t > HOPELESS_T or beliefs.robot_r > HOPELESS_R:
        return (
            "inconsistent",
            "the flange poses do not fit the frames: they miss by "
            f"{1e3 * beliefs.robot_t:.1f} mm and {np.degrees(beliefs.robot_r):.2f} degrees",
            left_open,
        )
    if fault or left_open:
        names = ", ".join(o.name for o in left_open)
        parts = [fault] if fault else []
        if names:
            parts.append(f"motions and depths leave to the start, in flange axes: {names}")
        return "weak", "; ".join(parts), left_open
    if away.max() > FAR:
        return (
            "far",
            f"the transform ended {away.max():.1f} standard deviations of the start away from it; "
            "state a larger --start-error if it may be that far off",
            left_open,
        )
    if ended:
        return "not_converged", ended, left_open
    return "converged", "motions and depths fix the transform", left_open
