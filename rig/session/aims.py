"""Camera poses that a session file says in other words: looking somewhere, grids, domes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import se3
from depthba.board_views import Views
from depthba.boards import Board
from depthba.camera import Camera
from rig.session.poses import Calibration, Dome, Grid, Look, Steps

Array = NDArray[np.float64]

_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
"""Steps of this angle spread evenly over all sides, however many there are."""
_DOWN = np.diag([1.0, -1.0, -1.0])
"""R_world_camera of a camera that looks straight down, the image's x along world x."""


def facing(direction: ArrayLike, roll: ArrayLike = 0.0) -> Array:
    """R_world_camera (..., 3, 3) of cameras that look along world directions (..., 3).

    From looking straight down, turned the shortest way, then by `roll` (...), rad, about the view.
    """
    d = np.asarray(direction, float)
    d = d / np.linalg.norm(d, axis=-1, keepdims=True)
    axis = np.cross([0.0, 0.0, -1.0], d)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, -d[..., 2:])
    # Straight up every axis is as short a way: about world x then.
    tiny = sine < 1e-9
    axis = np.where(tiny, [1.0, 0.0, 0.0], axis / np.where(tiny, 1.0, sine))
    spin = np.zeros((*np.shape(roll), 3))
    spin[..., 2] = roll
    return np.asarray(se3.exp_so3(angle * axis) @ _DOWN @ se3.exp_so3(spin))


def look_pose(look: Look) -> Array:
    """T_world_camera (4, 4)."""
    way = np.subtract(look.towards, look.at)
    return se3.make(facing(way, np.radians(look.roll_deg)), look.at)


def grid_poses(grid: Grid) -> Array:
    """T_world_camera (N, 4, 4), row by row, every other row back."""
    xs, ys = _spread(*grid.x, grid.counts[0]), _spread(*grid.y, grid.counts[1])
    gaze = np.array(
        [(x, y, grid.z) for row, y in enumerate(ys) for x in (xs if row % 2 == 0 else xs[::-1])]
    )
    n = np.arange(len(gaze))
    side, tilt = _GOLDEN * n, np.radians(grid.tilt_deg)
    view = np.stack(
        [np.sin(tilt) * np.cos(side), np.sin(tilt) * np.sin(side), np.full(len(n), -np.cos(tilt))],
        axis=-1,
    )
    R = facing(view, _swinging(grid.roll_deg, n) + np.radians(grid.yaw_deg))
    distance = np.broadcast_to(grid.distance, (2,))[n % 2]
    return se3.make(R, gaze - distance[:, None] * view)


def dome_poses(dome: Dome) -> Array:
    """T_world_camera (N, 4, 4), ring by ring; every other ring stands in the gaps."""
    view = []
    for ring, (tilt, count) in enumerate(zip(np.radians(dome.tilts_deg), dome.counts, strict=True)):
        share = (np.arange(count) + 0.5 * (ring % 2)) / count
        side = 2.0 * np.pi * share + np.radians(dome.first_deg)
        down = np.full(count, -np.cos(tilt))
        view.append(
            np.stack([-np.sin(tilt) * np.cos(side), -np.sin(tilt) * np.sin(side), down], axis=-1)
        )
    directions = np.concatenate(view)
    R = facing(directions, _swinging(dome.roll_deg, np.arange(len(directions))))
    return se3.make(R, np.array(dome.centre) - dome.radius * directions)


def board_pose(aim: Calibration) -> Array:
    """T_world_board (4, 4) of the board that a calibration looks at, as `depthba.boards` has it."""
    z = -np.array(aim.facing) / np.linalg.norm(aim.facing)
    # World x as it lies in the board; where the board faces along it, world y.
    along = [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0]
    x = along - (along @ z) * z
    x /= np.linalg.norm(x)
    # Turned about `facing`, which is -z.
    R = np.column_stack([x, np.cross(z, x), z]) @ se3.exp_so3([0, 0, -np.radians(aim.turn_deg)])
    middle = Board.parse(aim.board).corners().mean(axis=0)
    return se3.make(R, np.array(aim.at) - R @ middle)


def calibration_views(aim: Calibration, camera: Camera) -> list[Array]:
    """Stacks (m, 4, 4) of alternative T_world_camera, the wanted first, for more views than asked.

    OptionError where the camera never sees the whole board.
    """
    views = Views(
        distance=aim.distance,
        tilt=(float(np.radians(aim.tilt_deg[0])), float(np.radians(aim.tilt_deg[1]))),
        roll=float(np.radians(aim.roll_deg)),
        rim=aim.slack,
    )
    T_world_board = board_pose(aim)
    rng = np.random.default_rng(aim.seed)
    wanted = views.wanted(Board.parse(aim.board), camera, aim.count, rng)
    return [np.asarray(T_world_board @ T_board_camera) for T_board_camera in wanted]


def step_positions(steps: Steps) -> Array:
    """Positions (N, axes), m; the first axis runs to and fro."""
    lines = [_spread(*ends) for ends in zip(steps.first, steps.last, steps.counts, strict=True)]
    positions: list[tuple[float, ...]] = [()]
    for line in reversed(lines):
        positions = [
            (value, *rest)
            for row, rest in enumerate(positions)
            for value in (line if row % 2 == 0 else line[::-1])
        ]
    return np.array(positions)


def _swinging(degrees: float, n: NDArray[np.int64]) -> Array:
    """0, to the one side, 0, to the other side, and so on, rad."""
    return np.radians(degrees) * np.array([0.0, 1.0, 0.0, -1.0])[n % 4]


def _spread(low: float, high: float, count: int) -> Array:
    """Evenly spaced numbers from end to end; one alone lies in the middle."""
    return np.linspace(low, high, count) if count > 1 else np.array([0.5 * (low + high)])
