"""A camera that replays what was recorded: a dataset folder, or a folder of depth images."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera
from depthba.errors import DatasetError
from rig.cameras.camera import CameraInfo, Capture
from rig.errors import CameraError

_IMAGES = (".png", ".tif", ".tiff")


@dataclass(frozen=True)
class FolderOptions:
    """What to replay. The intrinsics are for a folder of bare images; a dataset has its own."""

    path: Path
    """A dataset, or a folder of 16-bit depth images, replayed in the order of the numbers in their
    names; 0 is no measurement."""
    rgb: Path | None = None
    """Folder of 8-bit colour images of the same names, for bare depth images."""
    first: int = 0
    """Where to begin, counted from 0."""
    loop: bool = False
    """Begin again after the last; else a capture after it fails."""
    fx: float | None = None
    """px, as fy, cx and cy."""
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1 k2 p1 p2 k3, as in OpenCV."""
    depth_scale: float | None = None
    """Metres per count of a bare depth image."""


class FolderCamera:
    """`rig.cameras.camera.DepthCamera` that replays. A stamp is the host's clock at the capture."""

    Options = FolderOptions

    def __init__(self, options: FolderOptions):
        self._options = options
        self._frames: _Dataset | _Images | None = None
        self._next = 0

    def open(self) -> CameraInfo:
        """Read what is there. CameraError where nothing is, or where it is no depth."""
        path = self._options.path
        if not path.is_dir():
            raise CameraError(f"{path}: no such folder, expected a dataset or depth images")
        is_dataset = (path / "dataset.json").exists()
        self._frames = _Dataset(path) if is_dataset else _Images(self._options)
        count = len(self._frames)
        if not 0 <= self._options.first < count:
            raise CameraError(
                f"{path}: {count} frames, expected more than {self._options.first}"
                " (option first), counted from 0"
            )
        self._next = self._options.first
        return self._frames.info()

    def capture(self, timeout: float) -> Capture:
        """The next frame; CameraError after the last."""
        frames = self._frames
        if frames is None:
            raise CameraError(f"{self._options.path}: not open, expected open() first")
        if self._next >= len(frames):
            if not self._options.loop:
                raise CameraError(f"{self._options.path}: all {len(frames)} frames were replayed")
            self._next = 0
        stamp = time.time()
        depth, rgb = frames.read(self._next)
        self._next += 1
        return Capture(depth, stamp, rgb)

    def close(self) -> None:
        """Forget what was open."""
        self._frames = None


class _Dataset:
    """The frames of a dataset."""

    def __init__(self, path: Path):
        from depthba.dataset import Dataset

        try:
            self._dataset = Dataset.open(path)
        except DatasetError as error:
            raise CameraError(str(error)) from error
        if self._dataset.sensor.camera is None:
            raise CameraError(f"{path}: a dataset of clouds, expected depth images")

    def __len__(self) -> int:
        return len(self._dataset)

    def info(self) -> CameraInfo:
        sensor = self._dataset.sensor
        assert sensor.camera is not None
        noise = sensor.noise
        return CameraInfo(
            model=sensor.model,
            serial="",
            camera=sensor.camera,
            depth_scale=sensor.depth_scale or 1e-4,
            depth_min=sensor.depth_min,
            depth_max=sensor.depth_max,
            noise=None if noise is None else (noise.sigma_m, noise.at_m, noise.power),
            settings={"replayed": self._dataset.name},
        )

    def read(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
        frame = self._dataset[index]
        try:
            return frame.depth(), frame.rgb()
        except DatasetError as error:
            raise CameraError(str(error)) from error


class _Images:
    """Bare depth images."""

    def __init__(self, options: FolderOptions):
        self._options = options
        self._paths = sorted(_images(options.path), key=_number)
        if not self._paths:
            raise CameraError(
                f"{options.path}: no dataset.json and no {', '.join(_IMAGES)} in it,"
                " expected a dataset or depth images"
            )
        intrinsics = (options.fx, options.fy, options.cx, options.cy, options.depth_scale)
        if None in intrinsics:
            raise CameraError(
                f"{options.path}: bare depth images, expected the options"
                " fx, fy, cx, cy and depth_scale"
            )
        fx, fy, cx, cy, scale = (value for value in intrinsics if value is not None)
        height, width = self._counts(0).shape
        self._camera = Camera(width, height, fx, fy, cx, cy, options.distortion)
        self._scale = scale

    def __len__(self) -> int:
        return len(self._paths)

    def info(self) -> CameraInfo:
        return CameraInfo(
            model="",
            serial="",
            camera=self._camera,
            depth_scale=self._scale,
            settings={"replayed": self._options.path.name},
        )

    def read(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
        counts = self._counts(index)
        expected = (self._camera.height, self._camera.width)
        if counts.shape != expected:
            raise CameraError(
                f"{self._paths[index]}: shape {counts.shape}, expected {expected} as the first"
            )
        depth = np.where(counts > 0, counts * np.float64(self._scale), np.nan).astype(np.float32)
        return depth, self._colour(index)

    def _counts(self, index: int) -> NDArray[np.uint16]:
        pixels = _read(self._paths[index])
        if pixels.ndim != 2 or pixels.dtype != np.uint16:
            raise CameraError(
                f"{self._paths[index]}: image of shape {pixels.shape} {pixels.dtype},"
                " expected one channel of 16 bit"
            )
        return pixels

    def _colour(self, index: int) -> NDArray[np.uint8] | None:
        if self._options.rgb is None:
            return None
        stem = self._paths[index].stem
        found = [path for path in _images(self._options.rgb, ".jpg") if path.stem == stem]
        if not found:
            raise CameraError(f"{self._options.rgb}: no image named {stem}, expected its colour")
        pixels = _read(found[0])
        expected = (self._camera.height, self._camera.width, 3)
        if pixels.shape != expected or pixels.dtype != np.uint8:
            raise CameraError(
                f"{found[0]}: shape {pixels.shape} {pixels.dtype}, expected {expected} uint8"
            )
        return np.ascontiguousarray(pixels[..., ::-1])


def _images(folder: Path, *more: str) -> Iterator[Path]:
    try:
        yield from (p for p in folder.iterdir() if p.suffix.lower() in (*_IMAGES, *more))
    except OSError as error:
        raise CameraError(f"{folder}: {error.strerror}, expected a folder of images") from error


def _number(path: Path) -> list[tuple[int, str]]:
    """Sort 2.png before 10.png."""
    parts = re.split(r"(\d+)", path.stem)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def _read(path: Path) -> NDArray:
    import cv2  # slow to import, so only where images are

    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise CameraError(f"{path}: cannot be read as an image")
    return np.asarray(pixels)
