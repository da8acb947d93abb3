"""One way to read and write points, whatever the file; told by the suffix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import durable, ply
from depthba.convert import files
from depthba.convert.clouds import las, pcd
from depthba.convert.packages import package
from depthba.errors import DatasetError

Array = NDArray[np.float64]

SUFFIXES = (".ply", ".pcd", ".xyz", ".las", ".laz", ".e57")


def read(path: Path) -> Array:
    """Return the points (n, 3) of a file that holds one cloud, in its own units."""
    suffix = path.suffix.lower()
    if suffix == ".xyz":
        # what follows x y z is colour, intensity or normals
        return files.numbers(path, *range(3, 13))[:, :3]
    if suffix in (".las", ".laz"):
        return las.read(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror}, expected a readable cloud") from error
    if suffix == ".pcd":
        return pcd.parse(data, str(path)).points
    points = _ply(data, path)
    return points[np.isfinite(points).all(axis=1)]


def write(
    path: Path,
    points: Array,
    colours: NDArray[np.uint8] | None = None,
    T_world_sensor: Array | None = None,
) -> None:
    """Write points (n, 3), m, and colours (n, 3) uint8 RGB; the pose where a file has one."""
    suffix = path.suffix.lower()
    if suffix == ".ply":
        ply.write_ply(path, points, colours)
    elif suffix == ".pcd":
        T = np.eye(4) if T_world_sensor is None else T_world_sensor
        durable.write_bytes(path, pcd.pcd_bytes(points, colours, T))
    elif suffix == ".xyz":
        rows = points if colours is None else np.column_stack([points, colours])
        form = "%.9g %.9g %.9g" + ("" if colours is None else " %d %d %d")
        durable.write_text(path, "".join(form % tuple(row) + "\n" for row in rows))
    elif suffix in (".las", ".laz"):
        las.write(path, points, colours)
    else:
        raise DatasetError(f"{path}: suffix {suffix!r}, expected one of {' '.join(SUFFIXES)}")


def _ply(data: bytes, path: Path) -> Array:
    """Read a PLY file; text and what is no plain cloud through trimesh."""
    if b"format ascii" not in data[:4096] and b"property list" not in data[:4096]:
        return ply.parse_ply_points(data, str(path), np.float64).astype(np.float64)
    trimesh = package("trimesh", "PLY as text")
    try:
        loaded = trimesh.load(str(path), process=False)
        return np.array(loaded.vertices, dtype=np.float64).reshape(-1, 3)
    except Exception as error:  # whatever it stumbles over
        raise DatasetError(f"{path}: {error}, expected a PLY file") from error
