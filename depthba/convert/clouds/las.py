"""LAS and LAZ files, through laspy."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import bounds
from depthba.convert.packages import package
from depthba.errors import DatasetError

Array = NDArray[np.float64]

_CHUNK = 1 << 18
"""Points that are unpacked at once."""
_RECORDS, _RECORD = 100, 54
"""Byte of the head at which the number of variable-length records stands, and least size of one."""
_ITEMS = 32
"""Byte of the record on compression at which the number of a point's items stands."""
_TOGETHER, _MOST_TOGETHER, _AS_TOLD = 12, 1 << 21, (1 << 32) - 1
"""Byte of the points in a chunk there; most that are taken; what stands for: as the table says."""
STEP = 1e-5
"""Of written coordinates, m; 32 bits of it reach over 40 km."""


def read(path: Path) -> Array:
    """Return the points (n, 3), units of the file."""
    laspy = package("laspy", "LAS")
    try:
        stored = path.stat().st_size
        _check_records(path, stored)
        with laspy.open(path, read_evlrs=False) as file:
            header = file.header
            if header.are_points_compressed:
                _check_chunks(path, header.offset_to_point_data, header.point_count)
                _check_items(header.vlrs.get("LasZipVlr"), header.point_format.size)
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
    except Exception as error:  # broken files fail in many ways
        raise DatasetError(f"{path}: {error}, expected a LAS or LAZ file") from error
    except BaseException as error:  # some of them in Rust, whose panic is no Exception
        if type(error).__name__ != "PanicException":
            raise
        raise DatasetError(f"{path}: {error}, expected a LAS or LAZ file") from error
    return points


def _check_records(path: Path, stored: int) -> None:
    """Refuse more records before the points than fit: the library would count to their number."""
    with path.open("rb") as file:
        head = file.read(_RECORDS + 4)
    if len(head) < _RECORDS + 4:
        raise ValueError(f"{stored} bytes, cut off in its head")
    (records,) = struct.unpack_from("<I", head, _RECORDS)
    if records * _RECORD > stored:
        raise ValueError(f"{records} records in {stored} bytes")


def _check_chunks(path: Path, begin: int, points: int) -> None:
    """Refuse a table of more chunks than points, for which the library would end the process."""
    data = path.read_bytes()
    if len(data) < begin + 8:
        raise ValueError("cut off before its points")
    (at,) = struct.unpack_from("<q", data, begin)
    if at == -1:  # written to what could not go back: it stands at the end
        (at,) = struct.unpack_from("<q", data, len(data) - 8)
    if not begin + 8 <= at <= len(data) - 8:
        raise ValueError(f"its table of chunks at byte {at} of {len(data)}")
    _, chunks = struct.unpack_from("<II", data, at)
    if chunks > points + 1:
        raise ValueError(f"{chunks} chunks of {points} points")


def _check_items(records: list[Any], size: int) -> None:
    """Refuse items of a compressed point that do not make up one, and chunks too large for memory.

    The library would divide by 0, and end the process.
    """
    data = records[0].record_data_bytes() if records else b""
    count = struct.unpack_from("<H", data, _ITEMS)[0] if len(data) >= _ITEMS + 2 else 0
    (together,) = struct.unpack_from("<I", data, _TOGETHER) if data[_TOGETHER + 3 :] else (0,)
    if _MOST_TOGETHER < together < _AS_TOLD:
        raise ValueError(f"chunks of {together} points")
    if len(data) < _ITEMS + 2 + 6 * count:
        raise ValueError(f"{count} items in a record of {len(data)} bytes")
    sizes = [struct.unpack_from("<HHH", data, _ITEMS + 2 + 6 * k)[1] for k in range(count)]
    if sum(sizes) != size:
        raise ValueError(f"items of {sum(sizes)} bytes for points of {size}")


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
