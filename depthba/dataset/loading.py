"""The files of a frame: read once, checked against their sha256, decoded, or `MalformedError`."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import ply
from depthba.dataset import images
from depthba.dataset.faults import MalformedError
from depthba.dataset.sensor import Sensor
from depthba.errors import DatasetError


def load_bytes(path: Path, sha256: str) -> bytes:
    """Return the bytes of a file whose sha256 is as listed."""
    try:
        if path.exists() and not path.is_file():  # reading a pipe would wait for ever
            raise MalformedError("not a regular file")
        data = path.read_bytes()
    except OSError as error:
        raise MalformedError(f"{error.strerror}, expected a readable file") from error
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        raise MalformedError(f"sha256 is {found}, expected {sha256}: its bytes have changed")
    return data


def load_depth(path: Path, sha256: str, sensor: Sensor) -> NDArray[np.float32]:
    """Return depth (height, width) in metres, NaN where nothing was measured in range."""
    return images.decode_depth(load_bytes(path, sha256), sensor)


def load_rgb(path: Path, sha256: str, sensor: Sensor) -> NDArray[np.uint8]:
    """Return colour (height, width, 3), RGB."""
    return images.decode_rgb(load_bytes(path, sha256), sensor)


def load_cloud(path: Path, sha256: str, sensor: Sensor) -> NDArray[np.float32]:
    """Return the points (n, 3) in the sensor frame, metres, of which z is in range."""
    data = load_bytes(path, sha256)
    try:
        points = ply.parse_ply_points(data, path.name)
    except DatasetError as error:
        raise MalformedError(str(error).removeprefix(f"{path.name}: ")) from error
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        found = ", ".join(f"{v:g}" for v in points[row])
        raise MalformedError(f"point {row} is ({found}), expected finite coordinates")
    seen = np.ones(len(points), dtype=bool)
    if sensor.depth_min is not None:
        seen &= points[:, 2] >= sensor.depth_min
    if sensor.depth_max is not None:
        seen &= points[:, 2] <= sensor.depth_max
    return np.asarray(points[seen])
