"""Scenes that are made to be hard, and the one thing asked of their registration.

It is right, or says by its status or an error that it is not to be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import depthba
from depthba import se3
from depthba.dataset import Dataset, DatasetWriter
from depthba.options import Options
from depthba.result import Result
from tests.depthba.analytic_scene import (
    FOCAL,
    HEIGHT,
    SIGMA_R,
    SIGMA_T,
    WIDTH,
    Floats,
    Surface,
    bumpy,
    cameras,
    ray_cast,
    truth_of,
)

# An answer is wrong where it is off by more than so many of its own standard deviations,
DEVIATIONS = 5.0
# and by more than this in a scene a metre away; turns count at the distance of the scene.
LEAST = 1e-4


@dataclass(frozen=True, eq=False)
class Views:
    """What a camera saw a metre above a surface, and where it was: before anything goes wrong."""

    depth: Floats
    """(N, HEIGHT, WIDTH), m."""
    T_true: Floats
    """(N, 4, 4), T_world_camera."""
    T_measured: Floats
    """(N, 4, 4)."""

    def but(self, **changed: Floats) -> Views:
        """Return the views with some of it replaced."""
        return replace(self, **changed)

    def scaled(self, factor: float) -> Views:
        """Return the views of a scene that is ``factor`` times as large."""
        T_true, T_measured = self.T_true.copy(), self.T_measured.copy()
        T_true[:, :3, 3] *= factor
        T_measured[:, :3, 3] *= factor
        return Views(factor * self.depth, T_true, T_measured)


def look(
    surface: Surface = bumpy,
    *,
    frames: int = 3,
    seed: int = 0,
    noise: float = 0.001,
    T_true: Floats | None = None,
) -> Views:
    """Look at a surface; poses are measured with SIGMA_T and SIGMA_R per axis, the first exactly.

    ``noise`` is a deviation along the ray, m.
    """
    rng = np.random.default_rng(seed)
    T_true = cameras(frames, rng) if T_true is None else T_true
    error = rng.standard_normal((len(T_true), 6)) * np.repeat([SIGMA_T, SIGMA_R], 3)
    error[0] = 0.0
    u, v = np.meshgrid((np.arange(WIDTH) - 39.5) / FOCAL, (np.arange(HEIGHT) - 29.5) / FOCAL)
    across = 1 / np.sqrt(1 + u * u + v * v)
    depth = np.stack([ray_cast(T, surface) for T in T_true])
    depth = depth + noise * rng.standard_normal(depth.shape) * across
    return Views(depth, T_true, se3.retract(T_true, error))


def sensor(*, scale: float = 1.0, noise: float = 0.001, **changed: Any) -> dict[str, Any]:
    """Return the sensor of the views, for a scene ``scale`` times as large."""
    return {
        "kind": "depth", "model": "analytic", "width": WIDTH, "height": HEIGHT, "fx": FOCAL,
        "fy": FOCAL, "cx": 39.5, "cy": 29.5, "distortion": [0] * 5, "depth_scale": 5e-5 * scale,
        "noise": {"sigma_m": noise * scale, "at_m": scale, "power": 0},
    } | changed  # fmt: skip


def write(
    path: Path, views: Views, *, scale: float = 1.0, map_frame: str = "world", **changed: Any
) -> Dataset:
    """Write views as a dataset; ``changed`` are keys of its sensor."""
    header = {
        "name": "trouble",
        "sensor": sensor(scale=scale, **changed),
        "map_frame": map_frame,
        "pose_noise": {"sigma_t_m": [scale * SIGMA_T] * 3, "sigma_r_rad": [SIGMA_R] * 3},
    }
    writer = DatasetWriter.create(path, header)
    for i, depth in enumerate(views.depth):
        writer.add_frame(
            stamp=float(i),
            depth=depth,
            T_world_camera=views.T_measured[i],
            T_world_camera_true=views.T_true[i],
        )
    return Dataset.open(path)


def register(dataset: Dataset, **options: Any) -> Result:
    """Register with one thread."""
    return depthba.register(dataset, Options(threads=1, **options))


def errors(result: Result, truth: Floats, scale: float = 1.0) -> tuple[Floats, Floats]:
    """Return errors (N, 6) and their stated standard deviations, in metres of a scene at 1 m."""
    unit = np.repeat([1 / scale, 1.0], 3)
    deviation = np.sqrt(np.diag(result.covariance)).reshape(-1, 6)
    return se3.difference(result.T_world_camera, truth) * unit, deviation * unit


def confidently_wrong(result: Result, truth: Floats, scale: float = 1.0) -> bool:
    """Whether a trusted result is off by more than it says."""
    found, stated = errors(result, truth, scale)
    beyond = np.abs(found) > DEVIATIONS * stated
    return result.trusted and bool((beyond & (np.abs(found) > LEAST)).any())


def assert_honest(result: Result, dataset: Dataset, scale: float = 1.0) -> None:
    """Fail where a trusted result is off by more than it says, or is not even finite."""
    assert np.isfinite(result.T_world_camera).all() and np.isfinite(result.covariance).all()
    found, stated = errors(result, truth_of(dataset), scale)
    assert not confidently_wrong(result, truth_of(dataset), scale), (
        f"{result.status}, off by {np.abs(found).max(axis=1)} m or rad, stated {stated.max(axis=1)}"
    )
