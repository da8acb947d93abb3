"""ScanNet's own file of a scan, .sens, version 4, as SensReader in its repository describes it.

Little-endian. A head of intrinsics, kinds of compression, sizes and steps of depth a metre; then
the frames: T_world_camera, two stamps in µs, the two images with their sizes in bytes. Depth comes
raw or packed by zlib, colour as JPEG or PNG; it is taken where it has the size of depth.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from depthba import bounds
from depthba.camera import Camera
from depthba.convert import files, intrinsics
from depthba.convert.reading import Reading
from depthba.convert.recording import Format, Recording, SourceFrame, left_out
from depthba.errors import DatasetError

Array = NDArray[np.float64]

VERSION = 4
RATE = 30.0
"""Frames a second, where the file has no stamps."""
RAW, ZLIB = 0, 1
_COLOURS = (1, 2)
"""PNG, JPEG."""
_MATRIX = np.dtype(("<f4", (4, 4)))
_LONGEST_NAME = 4096


@dataclass(frozen=True, eq=False)
class _Head:
    K: Array
    """Of depth, (4, 4)."""
    T_extra: Array
    """The extrinsics of depth, (4, 4)."""
    colours: int
    depths: int
    colour_size: tuple[int, int]
    size: tuple[int, int]
    """Of depth: width, height."""
    steps: float
    """Of depth a metre."""
    frames: int


@dataclass(frozen=True, eq=False)
class _Frame:
    pose: Array
    microseconds: int
    colour: tuple[int, int]
    """Where its bytes begin, and how many there are."""
    depth: tuple[int, int]


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    file = _file(path)
    return "" if file is None else file.name


def read(path: Path, reading: Reading) -> Recording:
    """Read a scan. Images are loaded from their places in the file when asked for."""
    path = _file(path) or path
    with path.open("rb") as file:
        head = _head(file, path)
        found = [_frame(file, path, k, head.frames) for k in range(head.frames)]
    scale = reading.depth_scale or 1 / head.steps
    camera = _camera(head, path, reading)
    stamps = np.array([frame.microseconds for frame in found]) * 1e-6
    if not (np.diff(stamps) > 0).all():
        stamps = np.arange(len(found)) / RATE
    aligned = head.colours in _COLOURS and head.colour_size == head.size
    frames, without = [], []
    for k, frame in enumerate(found):
        name = f"frame {k}"
        if not np.isfinite(frame.pose).all():
            without.append(name)
            continue
        place = f"{path}: {name}"
        frames.append(
            SourceFrame(
                name=name,
                stamp=float(stamps[k]),
                pose=frame.pose,
                depth=partial(_depth, path, frame.depth, head, scale, place),
                rgb=_colour(path, frame.colour, place) if aligned and frame.colour[1] else None,
                camera=camera,
            )
        )
    notes = left_out(without, "pose not finite, tracking was lost")
    if not aligned:
        notes += ("colour left out: not of the size of depth, or of a kind not known",)
    if not np.allclose(head.T_extra, np.eye(4), atol=1e-6):
        notes += ("the extrinsics of depth are not applied: poses are taken as those of depth",)
    return Recording(path, "sens", tuple(frames), depth_scale=scale, model="scannet", notes=notes)


def _file(path: Path) -> Path | None:
    """Return the scan itself, or the one in a scan's folder."""
    if path.is_file():
        return path if path.suffix.lower() == ".sens" else None
    there = list(path.glob("*.sens"))
    return there[0] if len(there) == 1 else None


def _camera(head: _Head, path: Path, reading: Reading) -> Camera:
    distortion = reading.distortion or (0.0,) * 5
    K = head.K
    lens = reading.intrinsics or (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    return intrinsics.made(*head.size, lens, distortion, str(path))


def _head(file: BinaryIO, path: Path) -> _Head:
    (version,) = _values(file, path, "<I")
    if version != VERSION:
        raise DatasetError(f"{path}: version {version}, expected {VERSION} of ScanNet's .sens")
    (length,) = _values(file, path, "<Q")
    if length > _LONGEST_NAME:
        raise DatasetError(f"{path}: a sensor's name of {length} bytes, expected ScanNet's .sens")
    _bytes(file, path, length)
    matrices = [_matrix(file, path) for _ in range(4)]  # of colour, its extrinsics; of depth, its
    colours, depths, *sizes, steps, count = _values(file, path, "<iiIIIIfQ")
    if depths not in (RAW, ZLIB):
        raise DatasetError(
            f"{path}: depth packed in way {depths}, expected {RAW} (raw) or {ZLIB} (zlib): "
            "export it with ScanNet's SensReader"
        )
    if not (np.isfinite(steps) and steps > 0):
        raise DatasetError(f"{path}: {steps} steps of depth a metre, expected more than 0")
    try:
        bounds.check_pixels(sizes[2], sizes[3])
        if not (sizes[2] and sizes[3]):
            raise ValueError(f"depth of {sizes[2]} x {sizes[3]} pixels, expected 1 at least")
    except ValueError as error:
        raise DatasetError(f"{path}: {error}") from error
    size, other = (sizes[2], sizes[3]), (sizes[0], sizes[1])
    return _Head(matrices[2], matrices[3], colours, depths, other, size, float(steps), count)


def _frame(file: BinaryIO, path: Path, k: int, count: int) -> _Frame:
    whole = f"frame {k} of {count}"
    pose = _matrix(file, path, whole)
    _, microseconds, colour, depth = _values(file, path, "<QQQQ", whole)
    begin = file.tell()
    if begin + colour + depth > os.fstat(file.fileno()).st_size:
        raise DatasetError(f"{path}: ends within {whole}, expected a whole file")
    file.seek(begin + colour + depth)
    return _Frame(pose, microseconds, (begin, colour), (begin + colour, depth))


def _depth(path: Path, place: tuple[int, int], head: _Head, scale: float, name: str) -> Array:
    data = _part(path, place)
    width, height = head.size
    wanted = 2 * width * height
    if head.depths == ZLIB:
        try:
            # a byte more tells what is too long, without unpacking all of it
            data = zlib.decompressobj().decompress(data, wanted + 1)
        except zlib.error as error:
            raise DatasetError(f"{name}: {error}, expected depth packed by zlib") from error
    if len(data) != wanted:
        raise DatasetError(
            f"{name}: {min(len(data), wanted + 1)} bytes of depth, expected {wanted} for {width} x "
            f"{height} pixels"
        )
    pixels = np.frombuffer(data, "<u2").reshape(height, width)
    return np.where(pixels > 0, pixels * scale, np.nan)


def _colour(path: Path, place: tuple[int, int], name: str) -> Callable[[], NDArray[np.uint8]]:
    return lambda: files.colour_of(_part(path, place), name)


def _part(path: Path, place: tuple[int, int]) -> bytes:
    with path.open("rb") as file:
        file.seek(place[0])
        return _bytes(file, path, place[1])


def _matrix(file: BinaryIO, path: Path, where: str = "its head") -> Array:
    data = _bytes(file, path, _MATRIX.itemsize, where)
    return np.frombuffer(data, "<f4").reshape(4, 4).astype(np.float64)


def _values(file: BinaryIO, path: Path, layout: str, where: str = "its head") -> tuple[int, ...]:
    return struct.unpack(layout, _bytes(file, path, struct.calcsize(layout), where))


def _bytes(file: BinaryIO, path: Path, count: int, where: str = "its head") -> bytes:
    data = file.read(count)
    if len(data) != count:
        raise DatasetError(f"{path}: ends within {where}, expected a whole file")
    return data


FORMAT = Format("sens", "ScanNet's own file of a scan: scene0000_00.sens", recognise, read)
