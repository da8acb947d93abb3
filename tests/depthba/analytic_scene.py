"""An analytic height field, ray-cast to rounding, and datasets of it whose truth is known."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.dataset import Dataset, DatasetWriter

Floats = NDArray[np.float64]
Surface = Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]

WIDTH, HEIGHT, FOCAL, SCALE = 80, 60, 80.0, 2e-5
SIGMA_T, SIGMA_R = 0.01, 0.01


def bumpy(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return height and gradient of smooth bumps, some 6 cm high and 30 cm wide."""
    a, b, c = 17.0 * x, 13.0 * y, 9.0 * x + 15.0 * y
    z = 0.02 * np.sin(a) * np.cos(b) + 0.012 * np.sin(c)
    along_x = 0.34 * np.cos(a) * np.cos(b) + 0.108 * np.cos(c)
    along_y = -0.26 * np.sin(a) * np.sin(b) + 0.18 * np.cos(c)
    return z, along_x, along_y


def flat(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return a plane that leans a little."""
    return 0.05 * x - 0.03 * y, np.full_like(x, 0.05), np.full_like(x, -0.03)


def ray_cast(T: Floats, surface: Surface) -> Floats:
    """Return the depth image (HEIGHT, WIDTH) in metres, by Newton steps along each ray."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - 39.5) / FOCAL, (v - 29.5) / FOCAL, np.ones(u.shape)], axis=-1)
    rays = rays @ T[:3, :3].T
    depth = -T[2, 3] / rays[..., 2]
    for _ in range(30):
        p = T[:3, 3] + depth[..., None] * rays
        z, along_x, along_y = surface(p[..., 0], p[..., 1])
        slope = rays[..., 2] - along_x * rays[..., 0] - along_y * rays[..., 1]
        depth = depth - (p[..., 2] - z) / slope
    p = T[:3, 3] + depth[..., None] * rays
    assert np.abs(p[..., 2] - surface(p[..., 0], p[..., 1])[0]).max() < 1e-12
    return np.asarray(depth)


def cameras(count: int, rng: np.random.Generator) -> Floats:
    """Return (count, 4, 4): 1 m above the field, side by side, turned and tilted, looking down."""
    T = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (count, 1, 1))
    turn = rng.uniform([-0.15, -0.15, -0.5], [0.15, 0.15, 0.5], (count, 3))
    T[:, :3, :3] = se3.exp_so3(turn) @ T[:, :3, :3]
    T[:, 0, 3] = 0.15 * (np.arange(count) - (count - 1) / 2)
    T[:, 1, 3] = rng.uniform(-0.15, 0.15, count)
    T[:, 2, 3] = rng.uniform(0.9, 1.0, count)
    return T


def write_scene(
    path: Path,
    *,
    surface: Surface = bumpy,
    frames: int = 5,
    seed: int = 0,
    noise: float = 0.001,
    start_error: bool = True,
    T_new_world: Floats | None = None,
    map_frame: str = "world",
    shift: dict[int, Floats] | None = None,
    empty: Iterable[int] = (),
    bend: Floats | None = None,
) -> Dataset:
    """Write a dataset of the surface.

    ``noise`` is a deviation along the ray, m; the measured poses are off by SIGMA_T, SIGMA_R per
    axis; ``T_new_world`` tells everything in another world frame; ``shift`` moves a frame's
    measured pose, m; the frames in ``empty`` measured nothing; ``bend`` (HEIGHT, WIDTH), m, is an
    error of the range that all frames share.
    """
    rng = np.random.default_rng(seed)
    T_true = cameras(frames, rng)
    error = rng.standard_normal((frames, 6)) * np.repeat([SIGMA_T, SIGMA_R], 3)
    error[0] = 0.0
    T_measured = se3.retract(T_true, error if start_error else 0 * error)
    T_world = np.eye(4) if T_new_world is None else T_new_world
    sensor: dict[str, Any] = {
        "kind": "depth", "model": "analytic", "width": WIDTH, "height": HEIGHT, "fx": FOCAL,
        "fy": FOCAL, "cx": 39.5, "cy": 29.5, "distortion": [0] * 5, "depth_scale": SCALE,
        "depth_min": 0.1, "depth_max": 1.3,
        "noise": {"sigma_m": max(noise, 1e-5), "at_m": 1.0, "power": 0},
    }  # fmt: skip
    header = {
        "name": "analytic",
        "sensor": sensor,
        "map_frame": map_frame,
        "pose_noise": {"sigma_t_m": [SIGMA_T] * 3, "sigma_r_rad": [SIGMA_R] * 3},
    }
    writer = DatasetWriter.create(path, header)
    u, v = np.meshgrid((np.arange(WIDTH) - 39.5) / FOCAL, (np.arange(HEIGHT) - 29.5) / FOCAL)
    along_ray = 1 / np.sqrt(1 + u * u + v * v)
    for i in range(frames):
        depth = ray_cast(T_true[i], surface)
        depth = depth + noise * rng.standard_normal(depth.shape) * along_ray
        if bend is not None:
            depth = depth + bend * along_ray
        if i in empty:
            depth = np.full_like(depth, np.nan)
        measured = T_measured[i].copy()
        measured[:3, 3] += (shift or {}).get(i, np.zeros(3))
        writer.add_frame(
            stamp=float(i),
            depth=depth,
            T_world_camera=T_world @ measured,
            T_world_camera_true=T_world @ T_true[i],
        )
    return Dataset.open(path)


def truth_of(dataset: Dataset) -> Floats:
    """Return the true poses (N, 4, 4)."""
    truth = dataset.T_world_camera_true
    assert truth is not None
    return truth


def pose_errors(T: Floats, truth: Floats) -> tuple[float, float]:
    """Return mean absolute errors per axis (m, rad); the first frame is aligned and left out."""
    error = se3.difference(se3.align_first(T, truth), truth)[1:]
    return float(np.abs(error[:, :3]).mean()), float(np.abs(error[:, 3:]).mean())
