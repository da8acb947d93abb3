"""Point clouds as binary PLY files.

Only what point clouds need: the scalar properties of one vertex element.
"""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import durable
from depthba.errors import DatasetError

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 65536
Real = TypeVar("Real", np.float32, np.float64)


def read_ply_points(path: str | Path) -> NDArray[np.float32]:
    """Read the points (n, 3) of a binary PLY file. `DatasetError` names what is wrong."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror}, expected a readable PLY file") from error
    return parse_ply_points(data, str(path))


def parse_ply_points(
    data: bytes,
    name: str,
    dtype: type[Real] = np.float32,  # type: ignore[assignment]
) -> NDArray[Real]:
    """Read the points (n, 3) from a binary PLY file's bytes; ``name`` is for the `DatasetError`."""
    order, elements, start = _parse_header(data, name)
    for position, (element, count, properties) in enumerate(elements):
        last = position == len(elements) - 1
        if any(kind == "list" for _, kind in properties):
            raise DatasetError(
                f"{name}: element {element!r} has a list property before or in the vertices,"
                " expected only scalars there"
            )
        row = _dtype(order, properties, name)
        end = start + count * row.itemsize
        if end > len(data):
            raise DatasetError(
                f"{name}: {len(data) - start} bytes of data for element {element!r},"
                f" expected {count} x {row.itemsize} = {count * row.itemsize}"
            )
        if element != "vertex":
            start = end
            continue
        for axis in "xyz":
            if row.names is None or axis not in row.names or row[axis].kind != "f":
                raise DatasetError(f"{name}: no float property {axis!r}, expected x, y and z")
        if last and end != len(data):
            raise DatasetError(
                f"{name}: {len(data) - end} bytes after the last of {count} vertices, expected none"
            )
        vertices = np.frombuffer(data, dtype=row, count=count, offset=start)
        return np.stack([vertices[axis].astype(dtype) for axis in "xyz"], axis=-1)
    raise DatasetError(f"{name}: no element 'vertex' in the PLY header")


def ply_bytes(points: ArrayLike, colours: ArrayLike | None = None) -> bytes:
    """Return a little-endian PLY of points (n, 3), as float32, and colours (n, 3) uint8 RGB."""
    p = np.asarray(points, dtype=np.float32)
    if p.ndim != 2 or p.shape[1] != 3:
        raise ValueError(f"points of shape {p.shape}, expected (n, 3)")
    fields: list[tuple[str, str]] = [(axis, "<f4") for axis in "xyz"]
    if colours is not None:
        fields += [(channel, "u1") for channel in ("red", "green", "blue")]
    vertices = np.empty(len(p), dtype=np.dtype(fields))
    for i, axis in enumerate("xyz"):
        vertices[axis] = p[:, i]
    if colours is not None:
        c = np.asarray(colours)
        if c.shape != p.shape or c.dtype != np.uint8:
            raise ValueError(f"colours of shape {c.shape} {c.dtype}, expected {p.shape} uint8")
        for i, channel in enumerate(("red", "green", "blue")):
            vertices[channel] = c[:, i]
    kinds = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(p)}"]
    header += [f"property {kinds[kind]} {field}" for field, kind in fields]
    return ("\n".join([*header, "end_header"]) + "\n").encode() + vertices.tobytes()


def write_ply(path: str | Path, points: ArrayLike, colours: ArrayLike | None = None) -> None:
    """Write points (n, 3) and colours (n, 3) uint8 RGB as a PLY file, whole or not at all."""
    durable.write_bytes(path, ply_bytes(points, colours))


_Element = tuple[str, int, list[tuple[str, str]]]


def _parse_header(data: bytes, name: str) -> tuple[str, list[_Element], int]:
    """Return the byte order, the elements with properties (name, type), and where data begin."""
    lines: list[list[str]] = []
    start = 0
    while True:
        end = data.find(b"\n", start, _LONGEST_HEADER)
        if end < 0:
            raise DatasetError(f"{name}: not a PLY file, or its header does not end")
        lines.append(data[start:end].decode("latin-1").split())
        start = end + 1
        if len(lines) == 1 and lines[0] != ["ply"]:
            raise DatasetError(f"{name}: begins with {data[:8]!r}, expected a PLY file")
        if lines[-1] == ["end_header"]:
            break
    order = ""
    elements: list[_Element] = []
    for words in lines[1:-1]:
        match words:
            case ["format", kind, "1.0"] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["format", *rest]:
                raise DatasetError(f"{name}: PLY format {' '.join(rest)!r}, expected binary 1.0")
            case ["element", element, count] if count.isdecimal() and len(count) < 19:
                elements.append((element, int(count), []))
            case ["property", "list", _, _, field] if elements:
                elements[-1][2].append((field, "list"))
            case ["property", kind, field] if elements and kind in _TYPES:
                elements[-1][2].append((field, _TYPES[kind]))
            case [] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                raise DatasetError(f"{name}: PLY header line {' '.join(words)!r} makes no sense")
    if not order:
        raise DatasetError(f"{name}: no format line in the PLY header")
    return order, elements, start


def _dtype(order: str, properties: list[tuple[str, str]], name: str) -> np.dtype[np.void]:
    fields = [field for field, _ in properties]
    if len(set(fields)) != len(fields):
        raise DatasetError(f"{name}: a PLY property is named twice among {', '.join(fields)}")
    return np.dtype([(field, order + kind) for field, kind in properties])
