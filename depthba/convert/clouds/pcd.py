"""PCD files, version 0.7: ascii, binary, and binary_compressed (LZF, column by column)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import bounds, se3
from depthba.compiling import kernel
from depthba.errors import DatasetError

Array = NDArray[np.float64]

_KINDS = {"F": "f", "I": "i", "U": "u"}
_LONGEST_HEADER = 4096


@dataclass(frozen=True, eq=False)
class Pcd:
    """What a PCD file holds."""

    points: Array
    """(n, 3), finite; units are the file's."""
    T_world_sensor: Array
    """(4, 4), VIEWPOINT."""


def parse(data: bytes, name: str) -> Pcd:
    """Read a PCD file's bytes; ``name`` is for the `DatasetError`."""
    header, start = _header(data, name)
    try:
        fields, kinds = header["FIELDS"], header["TYPE"]
        sizes = [int(v) for v in header["SIZE"]]
        counts = [int(v) for v in header.get("COUNT", ["1"] * len(fields))]
        number = int(header["POINTS"][0])
        if number < 0 or min(counts) < 1:
            raise ValueError(f"{number} points, {counts} numbers each")
        view = [float(v) for v in header.get("VIEWPOINT", ["0", "0", "0", "1", "0", "0", "0"])]
        dtype = np.dtype(
            [
                (f"{field}{k}" if field == "_" else field, f"<{_KINDS[kind]}{size}", (count,))
                for k, (field, kind, size, count) in enumerate(
                    zip(fields, kinds, sizes, counts, strict=True)
                )
            ]
        )
        coding = header["DATA"][0]
        tx, ty, tz, qw, qx, qy, qz = view
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise DatasetError(f"{name}: PCD header is not whole: {error!r}") from error
    if not {"x", "y", "z"} <= set(fields):
        raise DatasetError(f"{name}: fields {' '.join(fields)}, expected x y z among them")
    body = data[start:]
    if coding == "ascii":
        columns = _ascii(body, fields, counts, number, name)
    elif coding in ("binary", "binary_compressed"):
        if coding == "binary_compressed":
            body = _interleaved(_unpacked(body, name), dtype, number, name)
        if len(body) < number * dtype.itemsize:
            raise DatasetError(
                f"{name}: {len(body)} bytes of data, expected {number} x {dtype.itemsize}"
            )
        table = np.frombuffer(body, dtype, number)
        columns = [table[axis][:, 0].astype(np.float64) for axis in "xyz"]
    else:
        raise DatasetError(f"{name}: DATA {coding!r}, expected ascii, binary or binary_compressed")
    points = np.stack(columns, axis=1)
    return Pcd(
        points[np.isfinite(points).all(axis=1)], se3.from_quaternion([tx, ty, tz], [qx, qy, qz, qw])
    )


def pcd_bytes(points: Array, colours: NDArray[np.uint8] | None, T_world_sensor: Array) -> bytes:
    """Return a binary PCD of points (n, 3), as float32, and colours (n, 3) uint8 RGB."""
    fields = [(axis, "<f4") for axis in "xyz"] + ([("rgb", "<u4")] if colours is not None else [])
    table = np.empty(len(points), np.dtype(fields))
    for k, axis in enumerate("xyz"):
        table[axis] = points[:, k]
    if colours is not None:
        r, g, b = colours.astype(np.uint32).T
        table["rgb"] = (r << 16) | (g << 8) | b
    x, y, z, w = se3.quaternion(T_world_sensor)
    view = " ".join(f"{v:.17g}" for v in (*T_world_sensor[:3, 3], w, x, y, z))
    head = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(name for name, _ in fields),
        "SIZE " + " ".join("4" for _ in fields),
        # viewers take packed colours for floats, as the bits of which they were first written
        "TYPE " + " ".join("F" for _ in fields),
        "COUNT " + " ".join("1" for _ in fields),
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        f"VIEWPOINT {view}",
        f"POINTS {len(points)}",
        "DATA binary",
    ]
    return ("\n".join(head) + "\n").encode() + table.tobytes()


def _header(data: bytes, name: str) -> tuple[dict[str, list[str]], int]:
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = data.find(b"\n", start, _LONGEST_HEADER)
        if end < 0:
            raise DatasetError(f"{name}: not a PCD file, or its header does not end")
        words = data[start:end].decode("latin-1").partition("#")[0].split()
        start = end + 1
        if words:
            header[words[0]] = words[1:]
        if header and "VERSION" not in header:
            raise DatasetError(f"{name}: begins with {words[0][:20]!r}, expected a PCD file")
    return header, start


def _ascii(
    body: bytes, fields: list[str], counts: list[int], number: int, name: str
) -> list[Array]:
    try:
        table = np.array(body.split(), dtype=np.float64).reshape(-1, sum(counts))
    except ValueError as error:
        raise DatasetError(f"{name}: data are no table of numbers: {error}") from error
    if len(table) != number:
        raise DatasetError(f"{name}: {len(table)} points, expected {number} as the header says")
    begins = dict(zip(fields, np.cumsum([0, *counts]), strict=False))
    return [table[:, begins[axis]] for axis in "xyz"]


def _unpacked(body: bytes, name: str) -> NDArray[np.uint8]:
    if len(body) < 8:
        raise DatasetError(f"{name}: compressed data are cut off")
    packed, size = (int(v) for v in np.frombuffer(body, "<u4", 2))
    if len(body) < 8 + packed:
        raise DatasetError(f"{name}: {len(body) - 8} bytes of compressed data, expected {packed}")
    try:
        bounds.check_packed(size, len(body))
    except ValueError as error:
        raise DatasetError(f"{name}: {error}") from error
    out = np.zeros(size, np.uint8)
    if _lzf(np.frombuffer(body, np.uint8, packed, 8), out) != size:
        raise DatasetError(f"{name}: compressed data cannot be unpacked to {size} bytes")
    return out


def _interleaved(
    columns: NDArray[np.uint8], dtype: np.dtype[np.void], number: int, name: str
) -> bytes:
    """Put fields, each of which comes as a whole column, beside each other."""
    if len(columns) != number * dtype.itemsize:
        raise DatasetError(f"{name}: {len(columns)} bytes, expected {number} x {dtype.itemsize}")
    out = np.empty((number, dtype.itemsize), np.uint8)
    at = 0
    for field in dtype.names or ():
        inside, offset = dtype.fields[field][:2]  # type: ignore[index]
        width = inside.itemsize
        part = columns[at : at + number * width].reshape(number, width)
        out[:, offset : offset + width] = part
        at += number * width
    return out.tobytes()


@kernel
def _lzf(packed: NDArray[np.uint8], out: NDArray[np.uint8]) -> int:
    """Unpack LZF: literals, and references back into what is out already; -1 where it is broken.

    A control byte below 32 is followed by that many literals and one; else its three upper bits,
    and another byte where they are all set, are the length less 2, and the rest with the next byte
    the distance less 1.
    """
    i = o = 0
    while i < len(packed):
        control = int(packed[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > len(packed) or o + length > len(out):
                return -1
            for k in range(length):
                out[o + k] = packed[i + k]
            i += length
            o += length
            continue
        length = control >> 5
        if length == 7:
            if i >= len(packed):
                return -1
            length += int(packed[i])
            i += 1
        if i >= len(packed):
            return -1
        back = o - ((control & 31) << 8) - int(packed[i]) - 1
        i += 1
        length += 2
        if back < 0 or o + length > len(out):
            return -1
        for k in range(length):  # may overlap what it writes
            out[o + k] = out[back + k]
        o += length
    return o
