"""Images of a printed board as a camera on a flange sees it, in a dataset on disk."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.boards import Board
from depthba.camera import Camera
from depthba.dataset import Dataset, DatasetWriter
from tests.rig.board_problems import DEGREE, Setup, X, Y, views

Floats = NDArray[np.float64]

CAMERA = Camera(640, 360, 330.0, 330.0, 319.5, 179.5)
PIXELS = 32


def drawn(board: Board, T_camera_board: Floats) -> NDArray[np.uint8]:
    """What the camera sees, (360, 640, 3), each pixel the mean over its square."""
    print_ = cv2.copyMakeBorder(board.image(PIXELS), 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=255)
    # pixel of the print to m on the board: its first corner is 1.5 squares in
    s = board.square_m / PIXELS
    first = (0.5 - 2) * s - 1.5 * board.square_m
    to_board = np.array([[s, 0, first], [0, s, first], [0, 0, 1]])
    P = T_camera_board
    fine = 3
    K = np.diag([fine, fine, 1.0]) @ CAMERA.matrix
    K[:2, 2] += (fine - 1) / 2
    H = K @ np.column_stack([P[:3, 0], P[:3, 1], P[:3, 3]]) @ to_board
    size = (fine * CAMERA.width, fine * CAMERA.height)
    big = cv2.warpPerspective(
        print_, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=140
    )
    small = cv2.resize(big, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    return np.repeat(small[..., None], 3, axis=2)


def write_board(
    path: Path, board: Board | None = None, count: int = 10, named: bool = True, seed: int = 0
) -> Dataset:
    """Write a dataset of a board; the robot is good to 0.05 mm and 0.01 degrees."""
    board = board or Board()
    rng = np.random.default_rng(seed)
    P = views(Setup(count=count), rng)
    T = Y @ se3.inverse(P) @ se3.inverse(X)
    T = se3.retract(T, np.repeat([5e-5, 0.01 * DEGREE], 3) * rng.standard_normal((count, 6)))
    sensor = {
        "kind": "depth", "model": "drawn", "width": CAMERA.width, "height": CAMERA.height,
        "fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy,
        "distortion": [0] * 5, "depth_scale": 0.001,
    }  # fmt: skip
    writer = DatasetWriter.create(path, {"name": "board", "sensor": sensor})
    for k in range(count):
        writer.add_frame(
            stamp=3.0 * k,
            depth=np.full((CAMERA.height, CAMERA.width), np.nan),
            rgb=drawn(board, P[k]),
            T_world_camera=T[k] @ X,
            T_base_flange=T[k],
        )
    if named:
        writer.write_calibration({"board": board.json()})
    return Dataset.open(path)
