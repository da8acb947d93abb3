"""Corners of a board as a camera on a flange would see them, with the truth known.

Set up as problem 0 of the stored hand-eye problems: tilts of 7 to 35 degrees about any axis of the
board, turns of up to 60 degrees, 0.38 to 0.65 m away, aimed to within 6 cm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.boards import Board
from depthba.camera import Camera
from rig.hand_eye.board.observations import Mount, Observations

Floats = NDArray[np.float64]

CAMERA = Camera(1280, 720, 528.0, 528.0, 640.0, 360.0)
POINTS = Board().corners()
X = se3.make(se3.exp_so3([0.02, -0.06, 1.58]), [0.031, -0.062, 0.048])
Y = se3.make(se3.exp_so3([3.1, 0.1, 0.05]), [0.45, -0.1, 0.02])
DEGREE = np.pi / 180


@dataclass(frozen=True)
class Setup:
    """What is done and what goes wrong."""

    count: int = 20
    corner: float = 0.3
    """px."""
    robot_t: float = 0.00005
    """m."""
    robot_r: float = 0.01 * DEGREE
    """rad."""
    camera_off: tuple[float, float] = (0.0, 0.0)
    """Share by which the focal length is believed too long, and px by which the centre is off."""
    tilt: float = 35.0
    turn: float = 60.0
    """Degrees."""
    mount: Mount = "eye-in-hand"


COLUMNS = {
    "exact": Setup(),
    "K off": Setup(camera_off=(0.001, 1.5)),
    "robot x 10": Setup(robot_t=0.0005, robot_r=0.1 * DEGREE),
}
"""What is studied: focal length off by 0.1 % and centre by 1.5 px; a robot ten times worse."""


def views(setup: Setup, rng: np.random.Generator) -> Floats:
    """(N, 4, 4) T_camera_board."""
    n = setup.count
    about = rng.uniform(-np.pi, np.pi, n)
    tilt = rng.uniform(0.2, 1.0, n) * setup.tilt * DEGREE
    turn = rng.uniform(-1, 1, n) * setup.turn * DEGREE
    axis = np.stack([np.cos(about), np.sin(about), np.zeros(n)], axis=-1)
    R = se3.exp_so3(tilt[:, None] * axis) @ se3.exp_so3(turn[:, None] * [0, 0, 1])
    middle = rng.uniform([-0.06, -0.06, 0.38], [0.06, 0.06, 0.65], (n, 3))
    return se3.make(R, middle - R @ POINTS.mean(axis=0))


def problem(setup: Setup, seed: int) -> Observations:
    """Draw one; the truth is `X` and `Y`."""
    rng = np.random.default_rng(seed)
    return observed(setup, views(setup, rng), rng)


def observed(setup: Setup, P: Floats, rng: np.random.Generator) -> Observations:
    """What is seen and reported from views (N, 4, 4)."""
    G = X @ P @ se3.inverse(Y)
    T = se3.inverse(G) if setup.mount == "eye-in-hand" else G
    points = np.einsum("nij,mj->nmi", P[:, :3, :3], POINTS) + P[:, None, :3, 3]
    pixels = CAMERA.project(points)
    pixels = pixels + setup.corner * rng.standard_normal(pixels.shape)
    missed = np.repeat([setup.robot_t, setup.robot_r], 3) * rng.standard_normal((len(P), 6))
    longer, shift = setup.camera_off
    believed = Camera(
        1280, 720, CAMERA.fx * (1 + longer), CAMERA.fy * (1 + longer), 640 + shift, 360 + shift
    )
    return Observations(se3.retract(T, missed), POINTS, pixels, believed, setup.mount)


def error(found: Floats, truth: Floats = X) -> tuple[float, float]:
    """Degrees and millimetres."""
    delta = se3.difference(found, truth)
    return float(np.linalg.norm(delta[3:]) / DEGREE), float(1e3 * np.linalg.norm(delta[:3]))
