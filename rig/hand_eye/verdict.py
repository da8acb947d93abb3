"""Whether the motions and the depths fix the hand-eye transform, said before any number."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.optimiser.certainty import WEAK, direction_name
from rig.hand_eye.believed import Beliefs
from rig.hand_eye.chain import Chain
from rig.hand_eye.descent import Start

Array = NDArray[np.float64]

Status = Literal["converged", "not_converged", "weak", "inconsistent", "far"]
"""``converged``: done, to be trusted. ``not_converged``: stopped at a limit. ``weak``: done, but
motions and depths leave a direction open, which was held at the start. ``inconsistent``: flange
poses and frames do not belong together. ``far``: ended farther away than the start may be."""

# Turns of the flange (root mean square, rad) below which an axis counts as never turned about.
STILL = 0.01
# A robot that misses by more than this, m and rad, is no robot: the poses are others'.
HOPELESS_T, HOPELESS_R = 0.005, 0.01
# Ending farther from the start than this many of its standard deviations is no coincidence.
FAR = 4.0


@dataclass(frozen=True)
class Open:
    """A direction of X that the data leave to the start."""

    name: str
    """For people: such as ``z`` or ``turn about x``, in the flange's axes."""
    direction: Array
    """(6,) one standard deviation of the start, m and rad."""
    share: float
    """Share of the start in what is known about it, 0 to 1."""


def turned(T_base_flange: Array) -> tuple[Array, Array]:
    """Return how much the flange turned between frames, and about which axes.

    Returns:
        (3,) rad, root mean square over all pairs of frames, the largest first, and the axes (3, 3),
        one a column, in flange axes.
    """
    R = T_base_flange[:, :3, :3]
    i, j = np.triu_indices(len(R), 1)
    turns = se3.log_so3(np.swapaxes(R[i], -1, -2) @ R[j])
    values, axes = np.linalg.eigh(turns.T @ turns / max(len(turns), 1))
    return np.sqrt(np.maximum(values, 0.0))[::-1], axes[:, ::-1]


def motion_fault(T_base_flange: Array) -> str:
    """Say what the motions leave open whatever the scene; empty where they leave nothing.

    A shift of X moves all cameras alike, and so only the map, unless the flange turns; along an
    axis that all turns share, they do not help.
    """
    size, axes = turned(T_base_flange)
    if size[0] < STILL:
        return (
            "the flange never turned: the camera's place on it is not observable, only its "
            "orientation, which is the mounting tilt against the axes"
        )
    if size[1] < STILL:
        axis = axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0])
        shown = ", ".join(f"{v + 0.0:.2f}" for v in np.round(axis, 2))
        return (
            f"all turns of the flange have the parallel axis ({shown}): the camera's place along "
            "it is not observable"
        )
    return ""


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
    chain: Chain, covariance: Array, start: Start, beliefs: Beliefs, converged: bool
) -> tuple[Status, str, tuple[Open, ...]]:
    """Return status, reason and what is open."""
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
    if not converged:
        return "not_converged", "the iterations ended before the transform settled", left_open
    return "converged", "motions and depths fix the transform", left_open
