"""A small registration before the one that is timed, so that compiling and importing are not.

Three frames of waves with a few steps, seen from a metre, off by millimetres.
"""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import Camera
from depthba.dataset import Dataset, DatasetWriter
from eval.methods import Method, Task

Floats = NDArray[np.float64]

FRAMES, WIDTH, HEIGHT, FOCAL = 3, 128, 96, 110.0


def warm(method: Method, threads: int) -> None:
    """Run a method on the small scene, whatever comes of it."""
    with tempfile.TemporaryDirectory(prefix="depthba-") as folder, contextlib.suppress(Exception):
        method.run(Task.of(small_dataset(Path(folder) / "small"), threads=threads))


def small_dataset(path: Path) -> Dataset:
    """Write the small scene."""
    camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1))
    sensor = {
        "kind": "depth", "model": "analytic", "width": WIDTH, "height": HEIGHT,
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "distortion": [0] * 5, "depth_scale": 2e-5, "depth_min": 0.1, "depth_max": 1.3,
        "noise": {"sigma_m": 0.0005, "at_m": 1.0, "power": 0},
    }  # fmt: skip
    writer = DatasetWriter.create(path, {"name": "small", "sensor": sensor, "map_frame": "world"})
    rng = np.random.default_rng(0)
    for i in range(FRAMES):
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] = 0.15 * i, 0.05 * i, 1.0
        error = rng.normal(size=(1, 6)) * (0.003 if i else 0.0)
        depth = _depth(camera, T)
        writer.add_frame(
            stamp=float(i),
            depth=depth + rng.normal(size=depth.shape) * 0.0005,
            T_world_camera=se3.retract(T[None], error)[0],
            T_world_camera_true=T,
        )
    return Dataset.open(path)


def _depth(camera: Camera, T: Floats) -> Floats:
    """Return the depth image, m: the surface is flat enough for a fixed point to be drawn in."""
    rays = camera.rays() @ T[:3, :3].T
    depth = np.full(rays.shape[:2], 1.0)
    for _ in range(30):
        p = T[:3, 3] + depth[..., None] * rays
        depth = (_height(p[..., 0], p[..., 1]) - T[2, 3]) / rays[..., 2]
    return depth


def _height(x: Floats, y: Floats) -> Floats:
    waves = 0.03 * np.sin(7.0 * x) * np.cos(9.0 * y) + 0.02 * np.sin(17.0 * x + 6.0 * y)
    return waves + 0.02 * np.tanh(40.0 * np.sin(5.0 * x + 2.0 * y))
