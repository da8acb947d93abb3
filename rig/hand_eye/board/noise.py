"""How strong each kind of error is thought to be, and what is believed of what all poses share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.hand_eye.board.chain import CLOCK, LENS, SIZE, ZEROS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Noise:
    """Standard deviations."""

    corner: float
    """Of a corner along u and v, px."""
    robot_t: float
    """Of a flange's place, along each axis, m."""
    robot_r: float
    """Of a flange's orientation, about each axis, rad."""

    def flange(self) -> Array:
        """(6,), variance of what a flange misses, m^2 and rad^2."""
        return np.repeat([self.robot_t, self.robot_r], 3) ** 2


@dataclass(frozen=True)
class Prior:
    """What is believed of the camera, the board's size, the clock and the joints' zeros.

    Standard deviations; 0 holds a number where it is, infinity leaves it free.
    """

    reach: float = np.inf
    """How far X's camera may be from X's frame, along each axis, m: it matters where the motions
    leave that open."""
    lens: tuple[float, ...] = (0.0,) * 9
    """As `lens.NAMES` has them."""
    size: float = 0.0
    """Of the log of the board's size."""
    clock: float = 0.0
    """s."""
    zero: float = 0.0
    """Of a joint's zero, rad."""

    def sigma(self, shared: int) -> Array:
        """(s,), of all that is shared; X's rotation and Y are free."""
        sigma = np.full(shared, np.inf)
        sigma[:3] = self.reach
        sigma[LENS] = self.lens
        sigma[SIZE], sigma[CLOCK] = self.size, self.clock
        sigma[ZEROS:] = self.zero
        return sigma
