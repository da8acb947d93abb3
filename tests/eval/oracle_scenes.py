"""The two 12-frame scenes of the oracle files, as tasks."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from depthba import se3
from depthba.dataset import Dataset, DatasetWriter
from eval.methods.method import Task

Floats = NDArray[np.float64]

ORACLES = Path(__file__).parents[3] / "shared" / "oracles"
VOXELS = {"s0": 0.008, "s1": 0.010}
"""That the reference figures were made with, m."""
DEPTH_SCALE = 1.5e-5
"""Of the datasets' images, m; the clouds of the tasks are exact."""


def oracle(name: str) -> Path:
    """Return the path of an oracle file; the test is skipped where there is none."""
    path = ORACLES / name
    if not path.exists():
        pytest.skip(f"{name}: no reference figures beside the checkout")
    return path


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="depthba-oracle-scenes-")  # until the process ends


@functools.cache
def scene_overlap(name: str) -> Floats:
    """Return (12, 12), the share of frame j's points within 6 mm of frame i, where j > i."""
    with np.load(oracle("scenes_s0_s1.npz")) as file:
        return np.asarray(file[f"overlap_{name}"])


def scene_pairs(name: str, least: float = 0.25) -> list[tuple[int, int]]:
    """Return the frames (target i, source j > i) that overlap by more than ``least``."""
    i, j = np.nonzero(scene_overlap(name) > least)
    return [(int(a), int(b)) for a, b in zip(i, j, strict=True)]


@functools.cache
def scene_task(
    name: str, sigma_t: float = 0.01, sigma_r: float = 0.02, seed: int = 0
) -> tuple[Task, Floats]:
    """Return a scene and its true poses (12, 4, 4).

    Args:
        name: "s0" or "s1".
        sigma_t: standard deviation per axis of the start's translations, m; frame 0 is exact.
        sigma_r: and of its rotations, rad.
        seed: of the start.

    """
    with np.load(oracle("scenes_s0_s1.npz")) as file:
        depths = np.asarray(file[f"depth_{name}"], dtype=float)
        T_true = np.asarray(file[f"T_world_camera_{name}"])
        fx, cx, cy = (float(file[key]) for key in ("fx", "cx", "cy"))
    rng = np.random.default_rng(seed)
    off = rng.normal(size=(len(T_true), 6)) * ([sigma_t] * 3 + [sigma_r] * 3)
    off[0] = 0.0
    T_start = se3.retract(T_true, off)
    height, width = depths.shape[1:]
    sensor = {
        "kind": "depth",
        "model": "oracle",
        "width": width,
        "height": height,
        "fx": fx,
        "fy": fx,
        "cx": cx,
        "cy": cy,
        "distortion": [0, 0, 0, 0, 0],
        "depth_scale": DEPTH_SCALE,
    }
    path = Path(_folder().name) / f"{name}-{sigma_t}-{sigma_r}-{seed}"
    writer = DatasetWriter.create(path, {"name": name, "sensor": sensor, "map_frame": "world"})
    for i, depth in enumerate(depths):
        writer.add_frame(
            stamp=float(i),
            depth=depth,
            T_world_camera=T_start[i],
            T_world_camera_true=T_true[i],
        )
    dataset = Dataset.open(path)
    v, u = np.mgrid[:height, :width]
    rays = np.stack([(u - cx) / fx, (v - cy) / fx, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    clouds = tuple(rays * depth.reshape(-1, 1) for depth in depths)
    spacing = float(np.median([np.median(depth) for depth in depths]) / fx)
    return Task(dataset, T_start, clouds, spacing), T_true


def errors(T_est: Floats, T_true: Floats) -> tuple[float, float]:
    """Return the mean absolute errors, m and rad, as the reference figures define them."""
    est, true = (se3.inverse(T[0]) @ T for T in (T_est, T_true))
    t = est[1:, :3, 3] - true[1:, :3, 3]
    r = se3.log_so3(np.swapaxes(est[1:, :3, :3], 1, 2) @ true[1:, :3, :3])
    return float(np.abs(t).mean()), float(np.abs(r).mean())
