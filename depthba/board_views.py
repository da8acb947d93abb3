"""Views of a calibration board that fix a hand-eye transform: from all sides, near and far."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.boards import Board
from depthba.camera import Camera
from depthba.errors import OptionError

Array = NDArray[np.float64]

_PARTS = ("tilt", "roll", "distance", "x", "y")
"""Beside the azimuth, what makes a view."""


@dataclass(frozen=True)
class Views:
    """Which views of a board a calibration wants: near and far, upright and turned.

    The whole sheet is in each.
    """

    distance: tuple[float, float] = (0.35, 0.60)
    """Least and largest from the camera to the board's middle, m."""
    tilt: tuple[float, float] = (float(np.radians(6.0)), float(np.radians(40.0)))
    """Least and largest angle between the board's normal and the way to the camera, rad."""
    roll: float = float(np.radians(60.0))
    """Largest turn about the line of sight, to either side of upright, rad."""
    aim: float = 0.6
    """The part of the board, about its middle, that the camera is aimed at."""
    margin: float = 0.04
    """What stays free along the image's edges, as a share of its width and height."""
    rim: float = 0.0
    """What must be in the image around the sheet, m: as far as the board may be from where it is
    thought to be."""
    alternatives: int = 24
    """Poses offered for each view: the wanted one first, then others further and further off."""

    def wanted(
        self, board: Board, camera: Camera, count: int, rng: np.random.Generator
    ) -> Iterator[Array]:
        """Stacks (m, 4, 4) of alternative poses T_board_camera, one for each of 5 `count` views.

        `count` of them go twice round the board's normal; the others stand in for what cannot be
        had. OptionError if the camera never sees the whole board.
        """
        if self._pose(board, camera, np.array([0.0, 0.0, 0.5, 1.0, 0.5, 0.5])) is None:
            raise OptionError(
                f"board of {board.columns} x {board.rows} inner corners, squares of"
                f" {board.square_m} m: expected one that fits the image from {self.distance[1]} m"
            )
        start = rng.random(1 + len(_PARTS))
        for number in range(5 * count):
            view = np.empty(1 + len(_PARTS))
            # The second round looks from between the places of the first.
            view[0] = start[0] + 2.0 * number / (count + 1)
            view[1:] = (start[1:] + number * _STEP) % 1.0
            off = rng.uniform(-0.5, 0.5, (self.alternatives, len(view)))
            off *= np.linspace(0.0, 1.0, self.alternatives)[:, None]
            offered = view + off
            offered[:, 1:] = _folded(offered[:, 1:])
            poses = [self._pose(board, camera, one) for one in offered]
            fitting = [T for T in poses if T is not None]
            if fitting:
                yield np.array(fitting)

    def _pose(self, board: Board, camera: Camera, view: Array) -> Array | None:
        """The pose for an azimuth in turns and `_PARTS` in 0..1; further off if it must be."""
        azimuth = 2.0 * np.pi * view[0]
        tilt = self.tilt[0] + (self.tilt[1] - self.tilt[0]) * view[1]
        roll = self.roll * (2.0 * view[2] - 1.0)
        sheet = board.sheet(0.5 + self.rim / board.square_m)
        middle = sheet.mean(axis=0)
        aim = middle.copy()
        aim[:2] += self.aim * (view[4:] - 0.5) * np.ptp(board.sheet()[:, :2], axis=0)
        # The board's z points away from who sees it.
        way = np.array(
            [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)]
        )
        low, high = self.distance
        for distance in np.arange(low + (high - low) * view[3], high + 1e-9, 0.01):
            T = _looking(middle + distance * way, aim, roll)
            if self._fits(camera, sheet, T):
                return T
        return None

    def _fits(self, camera: Camera, sheet: Array, T_board_camera: Array) -> bool:
        T_camera_board = se3.inverse(T_board_camera)
        pixels = camera.project(sheet @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])
        size = np.array([camera.width, camera.height])
        share = (pixels + 0.5) / size
        return bool(((share >= self.margin) & (share <= 1.0 - self.margin)).all())


def _step(dimensions: int) -> Array:
    """Steps of an even additive sequence: powers of the root of x^(d+1) = x + 1 (Roberts 2018)."""
    root = 1.5
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    return np.asarray(root ** -np.arange(1.0, dimensions + 1.0))


_STEP = _step(len(_PARTS))


def _folded(share: Array) -> Array:
    """Shares reflected into 0..1."""
    return np.asarray(1.0 - np.abs(share % 2.0 - 1.0))


def _looking(eye: Array, at: Array, roll: float) -> Array:
    """T_board_camera (4, 4) of a camera at `eye` aimed at `at`; at roll 0 it is upright."""
    z = (at - eye) / np.linalg.norm(at - eye)
    y = np.cross(z, [1.0, 0.0, 0.0])
    y /= np.linalg.norm(y)
    upright = np.column_stack([np.cross(y, z), y, z])
    return np.asarray(se3.make(upright @ se3.exp_so3([0.0, 0.0, roll]), eye))
