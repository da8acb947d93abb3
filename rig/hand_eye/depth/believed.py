"""What is believed of each unknown beside the depth, and how strong each kind of error is.

The unknowns are X, the joints' zeros and the flanges, in this order. How much the last two scatter
is estimated along with them (expectation maximisation for variance components, Dempster, Laird &
Rubin 1977), since a robot is rarely as good as its data sheet says.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROUNDS = 60
# What is stated of the joints' zeros counts as much as this many joints.
STATED = 2.0


@dataclass(frozen=True)
class Beliefs:
    """Standard deviations of everything that is not a depth."""

    start: Array
    """(6,) of the start of X, m and rad."""
    zero: float
    """Of a joint's zero, rad."""
    robot_t: float
    """Of a flange's place, along each axis, m."""
    robot_r: float
    """Of a flange's orientation, about each axis, rad."""

    def variances(self, zeros: int, frames: int) -> Array:
        """Return the variance of each unknown."""
        flange = np.repeat([self.robot_t, self.robot_r], 3) ** 2
        return np.concatenate(
            [
                self.start**2,
                np.full(zeros, self.zero**2),
                np.tile(flange, frames),
            ]
        )


def estimate(
    H: Array, g: Array, now: Array, stated: Beliefs, zeros: int, frames: int
) -> tuple[Beliefs, Array, Array]:
    """Find how strong each kind of error is, and where that puts the unknowns.

    Args:
        H: (k, k) information of the depths.
        g: (k,) gradient, such that the depths alone would call for the step ``-H^-1 g``.
        now: (k,) the unknowns' present values.
        stated: the robot's errors are not taken to be smaller than here.
        zeros: number of joints.
        frames: number of frames.

    Returns:
        The beliefs, the step (k,) and the posterior covariance (k, k).
    """
    beliefs = stated
    flange = 6 + zeros + np.arange(6 * frames).reshape(frames, 6)
    joint = slice(6, 6 + zeros)
    for _ in range(ROUNDS):
        step, covariance = posterior(H, g, now, beliefs.variances(zeros, frames))
        moment = (now + step) ** 2 + np.diag(covariance)
        zero = (STATED * stated.zero**2 + moment[joint].sum()) / (STATED + zeros)
        beliefs = replace(
            beliefs,
            zero=float(np.sqrt(zero)),
            robot_t=max(stated.robot_t, float(np.sqrt(moment[flange[:, :3]].mean()))),
            robot_r=max(stated.robot_r, float(np.sqrt(moment[flange[:, 3:]].mean()))),
        )
    step, covariance = posterior(H, g, now, beliefs.variances(zeros, frames))
    return beliefs, step, covariance


def posterior(H: Array, g: Array, now: Array, variance: Array) -> tuple[Array, Array]:
    """Return the step (k,) and the covariance (k, k) where depths and beliefs are weighed up.

    Scaled by the beliefs, so that metres and radians do not spoil the inversion.
    """
    scale = np.sqrt(variance)
    inner = np.linalg.inv(np.eye(len(H)) + scale[:, None] * H * scale)
    covariance = scale[:, None] * inner * scale
    step = -covariance @ (g + now / variance)
    return step, (covariance + covariance.T) / 2
