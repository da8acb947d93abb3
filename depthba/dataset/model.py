"""Frames and markers: plain frozen data. Frames load their images when asked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba.dataset import loading
from depthba.dataset.cutting import Cut
from depthba.dataset.faults import MalformedError
from depthba.dataset.sensor import Sensor
from depthba.errors import DatasetError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StoredFile:
    """A file of a frame, as frames.jsonl lists it."""

    path: str
    """Relative to the dataset."""
    sha256: str
    """Of its bytes, lower-case hexadecimal."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame. What it loads is checked by its sha256; `DatasetError` names what is wrong."""

    id: int
    """Unique in the dataset, rising."""
    stamp: float
    """Seconds."""
    T_world_camera: Array = field(repr=False)
    """(4, 4), as measured; for clouds, camera stands for sensor."""
    sensor: Sensor = field(repr=False)
    root: Path = field(repr=False)
    """The dataset's folder."""
    files: Mapping[str, StoredFile] = field(repr=False)
    """Under ``depth`` and, where there is one, ``rgb``; or under ``cloud``."""
    joints: Array | None = field(repr=False, default=None)
    """Joint positions of the robot, radians (or metres), where known."""
    T_base_flange: Array | None = field(repr=False, default=None)
    """(4, 4), where known."""
    record: Mapping[str, Any] = field(repr=False, default_factory=dict)
    """The whole line of frames.jsonl, unknown keys too."""
    cuts: tuple[Cut, ...] = field(repr=False, default=())
    """What is left out when it is loaded, see `Dataset.crop`."""

    def depth(self) -> NDArray[np.float32]:
        """Return depth (height, width), metres; NaN where nothing was measured in range."""
        stored = self._stored("depth")
        try:
            depth = loading.load_depth(self.root / stored.path, stored.sha256, self.sensor)
        except MalformedError as error:
            raise self._error(stored, error) from error
        assert self.sensor.camera is not None  # there is a depth image
        for cut in self.cuts:
            depth = cut.depth(depth, self.sensor.camera)
        return depth

    def rgb(self) -> NDArray[np.uint8] | None:
        """Return colour (height, width, 3) as RGB, or None where the frame has none."""
        if "rgb" not in self.files:
            return None
        stored = self._stored("rgb")
        try:
            return loading.load_rgb(self.root / stored.path, stored.sha256, self.sensor)
        except MalformedError as error:
            raise self._error(stored, error) from error

    def points(self) -> NDArray[np.float32]:
        """Return the measured points (n, 3) in the sensor frame, metres, all finite; n may be 0.

        Depth pixels come in row order, undistorted; a cloud's points in the order of its file.
        """
        if self.sensor.camera is not None:
            return self.sensor.camera.backproject(self.depth()).astype(np.float32)
        stored = self._stored("cloud")
        try:
            points = loading.load_cloud(self.root / stored.path, stored.sha256, self.sensor)
        except MalformedError as error:
            raise self._error(stored, error) from error
        for cut in self.cuts:
            points = cut.points(points)
        return points

    def _stored(self, kind: str) -> StoredFile:
        if kind not in self.files:
            here = " and ".join(repr(name) for name in self.files)
            raise DatasetError(f"{self.root}: frame {self.id}: has no {kind!r}, only {here}")
        return self.files[kind]

    def _error(self, stored: StoredFile, error: MalformedError) -> DatasetError:
        return DatasetError(f"{self.root / stored.path}: frame {self.id}: {error}")


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker whose true position is known, and where the frames saw it."""

    name: str
    p_world: Array
    """(3,), metres."""
    observations: tuple[tuple[int, Array], ...]
    """Frame id and position (3,) in the sensor frame, metres."""
