"""Six frames of an analytic field with holes and colour, and what a round trip must keep."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from depthba.dataset import Dataset, DatasetWriter
from tests.depthba.analytic_scene import FOCAL, HEIGHT, WIDTH, bumpy, cameras, ray_cast

Floats = NDArray[np.float64]

STEP = 0.001
LENS = (FOCAL, FOCAL, 39.5, 29.5)


def poses(count: int = 6) -> Floats:
    return cameras(count, np.random.default_rng(5))


def depth(T: Floats) -> Floats:
    """Return depth in whole steps, with a hole and a lost row."""
    z = np.rint(ray_cast(T, bumpy) / STEP) * STEP
    z[10:14, 20:30] = np.nan
    z[0] = np.nan
    return z


def colour(k: int) -> NDArray[np.uint8]:
    return np.random.default_rng(k).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def write_depth_set(path: Path, rgb: bool = True) -> Dataset:
    fx, fy, cx, cy = LENS
    sensor: dict[str, Any] = {"kind": "depth", "model": "made-up", "width": WIDTH, "height": HEIGHT}
    sensor |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_scale": STEP}
    writer = DatasetWriter.create(
        path, {"name": "small", "sensor": sensor, "map_frame": "world", "seed": 3}
    )
    for k, T in enumerate(poses()):
        writer.add_frame(
            stamp=100.0 + 0.5 * k,
            T_world_camera=T,
            depth=depth(T),
            rgb=colour(k) if rgb else None,
            T_world_camera_true=T,
        )
    return Dataset.open(path)


def write_cloud_set(path: Path) -> Dataset:
    frames = write_depth_set(path.with_name(path.name + "-depth"))
    writer = DatasetWriter.create(path, {"sensor": {"kind": "cloud", "origin": True}})
    for frame in frames:
        writer.add_frame(
            stamp=frame.stamp, T_world_camera=frame.T_world_camera, cloud=frame.points()[::3]
        )
    return Dataset.open(path)


def write_png(path: Path, pixels: NDArray[Any]) -> None:
    """Write an image with OpenCV, as most programs do; colour is BGR there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels if pixels.ndim == 2 else pixels[..., ::-1])


def millimetres(T: Floats, unit: float = STEP) -> NDArray[np.uint16]:
    return np.nan_to_num(np.rint(depth(T) / unit)).astype(np.uint16)
