"""An analytic surface seen from a flange that turns as the test wants, with the truth known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.dataset import Dataset, DatasetWriter
from tests.depthba.analytic_scene import FOCAL, HEIGHT, SCALE, WIDTH, bumpy, ray_cast

Floats = NDArray[np.float64]

NOISE = 0.0005
X = se3.make(se3.exp_so3([0.05, -0.08, 0.5]), [0.04, -0.06, 0.05])
"""The true T_flange_camera."""
WRONG = np.array([0.01, -0.01, 0.01, 0.0174, 0.0174, -0.0174])
"""By which the dataset's is off, m and rad."""
DOWN = np.diag([1.0, -1.0, -1.0])


def flanges(count: int, axes: str) -> Floats:
    """Return (count, 4, 4) flange poses that look down from 1 m.

    They turn about the axes named, up to 20 degrees about x and y and 60 about z of the flange.
    """
    rng = np.random.default_rng(3)
    turn = rng.uniform(-1, 1, (count, 3)) * [0.35, 0.35, 1.0] * [a in axes for a in "xyz"]
    R = DOWN @ se3.exp_so3(turn)
    t = rng.uniform([-0.15, -0.15, 0.95], [0.15, 0.15, 1.05], (count, 3))
    # a flange that leans looks elsewhere: it stands where it still sees the middle
    t[:, :2] -= 0.9 * R[:, :2, 2] / -R[:, 2, 2:3]
    return se3.make(R, t)


def write_arm(path: Path, axes: str = "xyz", frames: int = 6, flange: bool = True) -> Dataset:
    """Write a dataset of the bumpy surface; the robot is exact to 0.03 mm and 0.005 degrees."""
    rng = np.random.default_rng(1)
    T_true = flanges(frames, axes)
    missed = rng.standard_normal((frames, 6)) * np.repeat([3e-5, 9e-5], 3)
    T_base_flange = se3.retract(T_true, missed)
    T_flange_camera = se3.retract(X, WRONG)
    sensor = {
        "kind": "depth", "model": "analytic", "width": WIDTH, "height": HEIGHT, "fx": FOCAL,
        "fy": FOCAL, "cx": 39.5, "cy": 29.5, "distortion": [0] * 5, "depth_scale": SCALE,
        "depth_min": 0.1, "depth_max": 1.3,
        "noise": {"sigma_m": NOISE, "at_m": 1.0, "power": 0},
    }  # fmt: skip
    header = {"name": "arm", "sensor": sensor, "map_frame": "world"}
    if flange:
        header["T_flange_camera"] = T_flange_camera.tolist()
    writer = DatasetWriter.create(path, header)
    u, v = np.meshgrid((np.arange(WIDTH) - 39.5) / FOCAL, (np.arange(HEIGHT) - 29.5) / FOCAL)
    along_ray = 1 / np.sqrt(1 + u * u + v * v)
    for i in range(frames):
        depth = ray_cast(T_true[i] @ X, bumpy)
        depth = depth + NOISE * rng.standard_normal(depth.shape) * along_ray
        depth[depth > 1.25] = np.nan
        writer.add_frame(
            stamp=float(i),
            depth=depth,
            T_world_camera=T_base_flange[i] @ T_flange_camera,
            T_base_flange=T_base_flange[i] if flange else None,
        )
    return Dataset.open(path)
