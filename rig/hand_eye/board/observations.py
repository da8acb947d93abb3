"""What a calibration with a board starts from: corners in images, and where the flange was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import Camera
from depthba.errors import OptionError
from depthba.kinematics import DhArm

Array = NDArray[np.float64]

Mount = Literal["eye-in-hand", "eye-to-hand"]
"""``eye-in-hand``: the camera rides on the flange, the board stands still. ``eye-to-hand``: the
camera stands still, the board rides on the flange."""

# Fewer corners than this do not hold a pose down.
FEWEST_CORNERS = 8


@dataclass(frozen=True, eq=False)
class Observations:
    """N poses from which M board points were seen, or some of them."""

    T_base_flange: Array
    """(N, 4, 4), as the robot reported them."""
    points: Array
    """(M, 3), m, board frame."""
    pixels: Array
    """(N, M, 2), (u, v); NaN where a point was not found."""
    camera: Camera
    """As believed; its distortion belongs to the pixels."""
    mount: Mount = "eye-in-hand"
    ids: tuple[int, ...] = ()
    """Of the frames, for people; empty: 0 to N - 1."""
    stamps: Array | None = None
    """(N,), s, by the camera's clock; None where unknown."""
    stamps_robot: Array | None = None
    """(N,), s, when the robot was read; None where unknown."""
    joints: Array | None = None
    """(N, 6, n), how the flanges move with the joints' zeros, m and rad per rad; None where the arm
    is not known."""
    arm: DhArm | None = None
    """The arm, where it is known, and"""
    q: Array | None = None
    """(N, n), rad, its joints."""
    velocity: Array | None = None
    """(N, 6), m/s and rad/s, base axes, of the flanges at the stamps; None: they stood."""

    def __post_init__(self) -> None:
        """OptionError where the shapes do not belong together."""
        n, m = len(self.T_base_flange), len(self.points)
        if self.pixels.shape != (n, m, 2):
            raise OptionError(
                f"pixels of shape {self.pixels.shape}: expected ({n}, {m}, 2), one row for each of"
                f" {n} flange poses and {m} board points"
            )
        if not se3.is_rigid(self.T_base_flange):
            raise OptionError("T_base_flange is not rigid, expected (N, 4, 4) in metres")
        if not self.ids:
            object.__setattr__(self, "ids", tuple(range(n)))

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.T_base_flange)

    @property
    def speed(self) -> Array:
        """(N, 6), the velocity, 0 where it is not known."""
        return np.zeros((len(self), 6)) if self.velocity is None else self.velocity

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(N, M), which points were found."""
        return np.asarray(np.isfinite(self.pixels).all(axis=-1))

    @property
    def carrier(self) -> Array:
        """(N, 4, 4), G in ``T_camera_board = X^-1 G Y``: what lies between X's and Y's frames.

        X = T_flange_camera, Y = T_base_board, G = T_flange_base with the eye in the hand;
        X = T_base_camera, Y = T_flange_board, G = T_base_flange with the eye to the hand.
        """
        if self.mount == "eye-in-hand":
            return se3.inverse(self.T_base_flange)
        return self.T_base_flange

    def subset(self, rows: Sequence[int] | NDArray[np.int64]) -> Observations:
        """Return the observations at these rows."""
        index = np.asarray(rows, dtype=np.int64)
        return replace(
            self,
            T_base_flange=self.T_base_flange[index],
            pixels=self.pixels[index],
            ids=tuple(self.ids[i] for i in index),
            stamps=None if self.stamps is None else self.stamps[index],
            stamps_robot=None if self.stamps_robot is None else self.stamps_robot[index],
            joints=None if self.joints is None else self.joints[index],
            q=None if self.q is None else self.q[index],
            velocity=None if self.velocity is None else self.velocity[index],
        )
