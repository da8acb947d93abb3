"""LAS and LAZ files, through laspy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import bounds
from depthba.convert.packages import package
from depthba.errors import DatasetError

Array = NDArray[np.float64]

_CHUNK = 1 << 18
"""Points that are unpacked at once."""
STEP = 1e-5
"""Of written coordinates, m; 32 bits of it reach over 40 km."""


def read(path: Path) -> Array:
    """Return the points (n, 3), units of the file."""
    laspy = package("laspy", "LAS")
    try:
        stored = path.stat().st_size
        with laspy.open(path) as file:
            header = file.header
            wanted = header.point_count * header.point_format.size
            if not header.are_points_compressed and wanted > stored:
                raise ValueError(f"{stored} bytes for {header.point_count} points")
            bounds.check_packed(max(wanted, 24 * header.point_count), stored)
            points = np.empty((header.point_count, 3))
            at = 0
            for chunk in file.chunk_iterator(_CHUNK):
                points[at : at + len(chunk)] = np.column_stack([chunk.x, chunk.y, chunk.z])
                at += len(chunk)
        if at != len(points):
            raise ValueError(f"{at} points, expected {len(points)} as its head says")
    except Exception as error:  # broken files fail in many ways, some of them in another language
        raise DatasetError(f"{path}: {error}, expected a LAS or LAZ file") from error
    return points


def write(path: Path, points: Array, colours: NDArray[np.uint8] | None) -> None:
    """Write points (n, 3), m, to `STEP`, and colours (n, 3) uint8 RGB; by the suffix LAS or LAZ."""
    laspy = package("laspy", "LAS")
    header = laspy.LasHeader(point_format=2 if colours is not None else 0, version="1.2")
    header.scales = np.full(3, STEP)
    # a multiple of the step, so that coordinates of that step stay as they are
    middle = points.mean(axis=0) if len(points) else np.zeros(3)
    header.offsets = np.rint(middle)
    cloud = laspy.LasData(header)
    cloud.xyz = points
    if colours is not None:
        wide = colours.astype(np.uint16) * 257  # the format has 16 bits
        cloud.red, cloud.green, cloud.blue = wide.T
    with path.open("wb") as file:
        cloud.write(file, do_compress=path.suffix.lower() == ".laz")
