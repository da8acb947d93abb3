"""The two scenes that the reference figures are from, and small scenes made of points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import Camera
from depthba.dataset import Dataset
from depthba.dataset.model import Frame
from depthba.dataset.sensor import Sensor
from eval.methods.method import Task
from tests.eval.oracle_scenes import oracle

Floats = NDArray[np.float64]


def reference_task(
    name: str, sigma_t: float = 0.0, sigma_r: float = 0.0, seed: int = 0
) -> tuple[Task, Floats, Floats]:
    """Scene s0 or s1 from the truth disturbed per axis (m, rad), frame 0 exact.

    Returns the task, the true poses (12, 4, 4) and the overlaps at the truth (12, 12).
    """
    with np.load(oracle("scenes_s0_s1.npz"), allow_pickle=False) as stored:
        depth = stored[f"depth_{name}"].astype(float)
        T_true, overlap = stored[f"T_world_camera_{name}"], stored[f"overlap_{name}"]
        f, cx, cy = (float(stored[k]) for k in ("fx", "cx", "cy"))
    camera = Camera(depth.shape[2], depth.shape[1], f, f, cx, cy)
    off = np.random.default_rng(seed).normal(size=(len(depth), 6))
    off *= [sigma_t] * 3 + [sigma_r] * 3
    off[0] = 0.0
    clouds = tuple(camera.backproject(z) for z in depth)
    return made_task(se3.retract(T_true, off), clouds, camera), T_true, overlap


def made_task(
    T_world_camera: Floats,
    clouds: tuple[Floats, ...],
    camera: Camera | None = None,
    spacing: float | None = None,
) -> Task:
    """Points as a task, with no dataset on disk behind it."""
    kind, scale = ("cloud", None) if camera is None else ("depth", 1e-4)
    sensor = Sensor(kind, "made-up", camera, scale, None, None, None, True)  # type: ignore[arg-type]
    frames = tuple(Frame(k, float(k), T, sensor, Path(), {}) for k, T in enumerate(T_world_camera))
    dataset = Dataset(Path(), "made-up", sensor, "world", None, None, None, {}, frames)
    if spacing is None:
        assert camera is not None
        spacing = float(np.median([np.median(p[:, 2]) for p in clouds]) / camera.fx)
    return Task(dataset, T_world_camera, clouds, spacing)
