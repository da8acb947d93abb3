"""Point clouds: what is written is read, and whatever else is read is a `DatasetError` at worst."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from depthba.errors import DatasetError
from depthba.ply import parse_ply_points, ply_bytes, read_ply_points, write_ply

POINTS = np.arange(12, dtype=np.float32).reshape(4, 3) / 7


@settings(deadline=None, max_examples=50)
@given(arrays.arrays(np.float32, st.tuples(st.integers(0, 20), st.just(3))), st.booleans())
def test_round_trip_is_exact(points: np.ndarray, coloured: bool) -> None:
    colours = np.full(points.shape, 7, np.uint8) if coloured else None
    np.testing.assert_array_equal(parse_ply_points(ply_bytes(points, colours), "x"), points)


def test_other_programs_can_read_it(tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", reason="open3d is not installed or lacks its libraries")
    colours = np.arange(12, dtype=np.uint8).reshape(4, 3)
    write_ply(tmp_path / "a.ply", POINTS, colours)
    cloud = open3d.io.read_point_cloud(str(tmp_path / "a.ply"))
    np.testing.assert_allclose(np.asarray(cloud.points), POINTS)
    np.testing.assert_allclose(np.asarray(cloud.colors) * 255, colours)
    np.testing.assert_array_equal(read_ply_points(tmp_path / "a.ply"), POINTS)


@pytest.mark.parametrize("order", ["<", ">"])
def test_extra_properties_and_elements_are_passed_over(order: str) -> None:
    camera = np.zeros(2, np.dtype([("f", order + "f8"), ("n", "u1")]))
    vertices = np.zeros(
        4, np.dtype([("i", "u1"), *((a, order + "f4") for a in "zxy"), ("t", order + "f8")])
    )
    for i, a in enumerate("xyz"):
        vertices[a] = POINTS[:, i]
    kind = {"<": "little", ">": "big"}[order]
    header = f"""ply\r
format binary_{kind}_endian 1.0\r
comment made up\r
obj_info too\r
element camera 2\r
property double f\r
property uchar n\r
element vertex 4\r
property uchar i\r
property float z\r
property float32 x\r
property float y\r
property double t\r
element face 1\r
property list uchar int vertex_indices\r
end_header\r
"""
    data = header.encode() + camera.tobytes() + vertices.tobytes() + b"\x03" + bytes(12)
    np.testing.assert_array_equal(parse_ply_points(data, "x"), POINTS)


GOOD = ply_bytes(POINTS)
BAD = {
    "empty": (b"", "does not end"),
    "no PLY": (b"\x89PNG\n\n" + GOOD, "expected a PLY file"),
    "ascii": (GOOD.replace(b"binary_little_endian", b"ascii"), "'ascii 1.0', expected binary"),
    "no format": (GOOD.replace(b"format binary_little_endian 1.0\n", b""), "no format line"),
    "no vertices": (GOOD.replace(b"element vertex", b"element vortex"), "no element 'vertex'"),
    "no x": (GOOD.replace(b"float x", b"float q"), "no float property 'x'"),
    "x is an integer": (GOOD.replace(b"float x", b"int x"), "no float property 'x'"),
    "y twice": (GOOD.replace(b"float x", b"float y"), "named twice"),
    "negative": (GOOD.replace(b"vertex 4", b"vertex -4"), "'element vertex -4' makes no sense"),
    "far too many": (GOOD.replace(b"vertex 4", b"vertex 9999999999"), "48 bytes of data"),
    "longer than any": (GOOD.replace(b"vertex 4", b"vertex " + b"9" * 5000), "makes no sense"),
    "a list": (GOOD.replace(b"float x", b"list uchar int x"), "list property"),
    "unknown type": (GOOD.replace(b"float x", b"half x"), "'property half x' makes no sense"),
    "cut off": (GOOD[:-1], "47 bytes of data for element 'vertex', expected 4 x 12 = 48"),
    "too long": (GOOD + b"x", "1 bytes after the last of 4 vertices"),
}


@pytest.mark.parametrize("case", BAD)
def test_malformed(case: str, tmp_path: Path) -> None:
    data, message = BAD[case]
    (tmp_path / "bad.ply").write_bytes(data)
    with pytest.raises(DatasetError, match=re.escape(message)) as error:
        read_ply_points(tmp_path / "bad.ply")
    assert str(tmp_path / "bad.ply") in str(error.value)
    assert "\n" not in str(error.value)


@settings(deadline=None, max_examples=200)
@given(st.integers(0, len(GOOD) - 1), st.integers(0, 255), st.booleans())
def test_damage_is_never_worse_than_a_known_error(at: int, byte: int, cut: bool) -> None:
    data = GOOD[:at] if cut else GOOD[:at] + bytes([byte]) + GOOD[at + 1 :]
    try:
        points = parse_ply_points(data, "x")
    except DatasetError:
        return
    assert points.dtype == np.float32 and points.shape[1:] == (3,)


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"none\.ply: No such file"):
        read_ply_points(tmp_path / "none.ply")
