"""E57 files, through pye57: scans in their own frames, each with its pose; metres by definition."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.convert.packages import package
from depthba.errors import DatasetError

Array = NDArray[np.float64]


def poses(path: Path) -> Array:
    """Return T_world_scan (N, 4, 4) of the scans in a file; the identity where one has no pose."""
    with _Opened(path) as file:
        out = np.tile(np.eye(4), (file.scan_count, 1, 1))
        for k in range(file.scan_count):
            header = file.get_header(k)
            if header.has_pose():
                w, x, y, z = np.asarray(header.rotation, dtype=np.float64)
                out[k] = se3.from_quaternion(
                    np.asarray(header.translation, dtype=np.float64), [x, y, z, w]
                )
    return out


def read(path: Path, scan: int) -> Array:
    """Return the points (n, 3), m, of one scan, in its own frame."""
    with _Opened(path) as file:
        try:
            data = file.read_scan(scan, transform=False, ignore_missing_fields=True)
        except Exception as error:  # its exceptions have no class of their own
            raise DatasetError(f"{path}: scan {scan}: {error}") from error
    points = np.stack([data[f"cartesian{axis}"] for axis in "XYZ"], axis=1).astype(np.float64)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def write(path: Path, scans: Sequence[tuple[Array, Array]]) -> None:
    """Write scans, each of points (n, 3) in its own frame and T_world_scan (4, 4), m."""
    pye57 = package("pye57", "E57")
    with pye57.E57(str(path), mode="w") as file:
        for points, T in scans:
            x, y, z, w = se3.quaternion(T)
            data = {f"cartesian{axis}": np.array(points[:, k]) for k, axis in enumerate("XYZ")}
            file.write_scan_raw(
                data, rotation=np.array([w, x, y, z]), translation=np.array(T[:3, 3])
            )


class _Opened:
    """An E57 file for reading; what the library throws becomes a known error."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self):  # type: ignore[no-untyped-def]
        pye57 = package("pye57", "E57")
        if not self._path.is_file():
            raise DatasetError(f"{self._path}: no such file, expected an E57 file")
        try:
            self._file = pye57.E57(str(self._path))
        except Exception as error:  # its exceptions have no class of their own
            raise DatasetError(f"{self._path}: {error}, expected an E57 file") from error
        return self._file

    def __exit__(self, *_: object) -> None:
        self._file.close()
