"""Writing the frames of a dataset as files of other formats."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import durable
from depthba.camera import Camera
from depthba.dataset import Dataset, Frame
from depthba.errors import DatasetError

Array = NDArray[np.float64]


def new_folder(path: Path, *below: str) -> None:
    """Make a folder that must not exist or be empty, with folders below it."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise DatasetError(f"{path}: is in the way, expected a new or empty folder")
    for name in below or (".",):
        durable.make_folder(path / name)


def camera_of(dataset: Dataset, title: str) -> Camera:
    """Return the camera of a dataset of depth images."""
    if dataset.sensor.camera is None:
        raise DatasetError(
            f"{dataset.path}: holds clouds, but {title} holds depth images: convert to clouds-ply"
        )
    return dataset.sensor.camera


def write_png(path: Path, pixels: NDArray[Any]) -> None:
    """Write a grey image, or colour as RGB (height, width, 3)."""
    import cv2

    image = pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., ::-1])
    written, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not written:
        raise DatasetError(f"{path}: the image could not be written as PNG")
    durable.write_bytes(path, png.tobytes())


def depth_pixels(frame: Frame, scale: float, largest: int = 65535) -> NDArray[np.uint16]:
    """Return depth in steps of ``scale`` m; 0 where nothing was measured.

    Raises:
        DatasetError: a depth is too far or too near for 16 bits at that scale.

    """
    z = frame.depth().astype(np.float64)
    seen = np.isfinite(z) & (z > 0)
    steps = np.where(seen, np.rint(np.where(seen, z, 0.0) / scale), 0.0)
    if (misfit := seen & ((steps < 1) | (steps > largest))).any():
        v, u = np.argwhere(misfit)[0]
        raise DatasetError(
            f"{frame.root}: frame {frame.id}: depth {z[v, u]:g} m at pixel (u {u}, v {v}), but the "
            f"format holds {scale:g} to {largest * scale:g} m: crop with --depth-range"
        )
    return steps.astype(np.uint16)


def each(dataset: Dataset, T_world_camera: Array) -> Iterator[tuple[int, Frame, Array]]:
    """Give every frame with its place and pose (4, 4)."""
    for k, (frame, T) in enumerate(zip(dataset, T_world_camera, strict=True)):
        yield k, frame, T
