"""Writing a dataset: what cannot be read back is refused before anything is written."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from depthba import durable, se3
from depthba.dataset import Dataset, DatasetWriter, Marker, verify
from depthba.errors import DatasetError


def tree(path: Path) -> dict[str, bytes]:
    """Return all files of a folder."""
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}


def test_equal_input_gives_equal_bytes(small: Any, tmp_path: Path) -> None:
    assert tree(small.write(tmp_path / "again").path) == tree(small.path)


def test_frames_are_committed_one_by_one(small: Any, tmp_path: Path) -> None:
    writer = DatasetWriter.create(tmp_path / "deep" / "new", small.header())
    for i in range(3):
        assert writer.add_frame(**small.frame(i)) == i
        assert len(Dataset.open(writer.path)) == len(writer) == i + 1
    assert writer.ids == (0, 1, 2) and writer.stamps == (10, 10.5, 11)
    assert not list(writer.path.rglob("*" + durable.PART))


def test_depth_is_rounded_to_the_nearest_step_and_never_wraps(small: Any, tmp_path: Path) -> None:
    header = small.header()
    del header["sensor"]["depth_min"], header["sensor"]["depth_max"]
    writer = DatasetWriter.create(tmp_path / "new", header)
    frame = {"T_world_camera": np.eye(4)}
    depth = np.full((6, 8), np.nan)
    depth[0, :5] = [0, 0.001, 0.0014999, 65.535, 65.53549]
    writer.add_frame(stamp=0, depth=depth, **frame)
    z = Dataset.open(writer.path)[0].depth()
    np.testing.assert_allclose(z[0, 1:5], [0.001, 0.001, 65.535, 65.535], rtol=1e-6)
    assert np.isnan(z[0, 0]) and np.isnan(z[1:]).all()
    before = tree(writer.path)
    for value in (65.5356, 65.6, 1e6, np.inf, -np.inf, -0.2, 0.0004):
        depth[3, 2] = value
        message = f"frame 1: depth {value:g} m at pixel (u 2, v 3) and 0 more do not fit 16 bits"
        with pytest.raises(DatasetError, match=re.escape(message)):
            writer.add_frame(stamp=1, depth=depth, **frame)
    assert tree(writer.path) == before


BAD_FRAMES: dict[str, tuple[dict[str, Any], str]] = {
    "size": (
        {"depth": np.ones((8, 6))},
        "depth of shape (8, 6), expected (height, width) = (6, 8)",
    ),
    "rgb size": ({"rgb": np.ones((6, 9, 3), np.uint8)}, "rgb of shape (6, 9, 3) uint8"),
    "rgb type": ({"rgb": np.ones((6, 8, 3))}, "rgb of shape (6, 8, 3) float64, expected"),
    "no depth": ({"depth": None}, "nothing given, expected depth"),
    "a cloud": ({"depth": None, "cloud": np.ones((1, 3))}, "cloud given, expected depth"),
    "both": ({"cloud": np.ones((1, 3))}, "depth and cloud given, expected depth"),
    "NaN stamp": ({"stamp": np.nan}, "stamp is NaN, expected a finite number"),
    "same stamp": ({"stamp": 10.0000005}, "stamp 10.000000500 is taken"),
    "NaN pose": ({"T_world_camera": np.full((4, 4), np.nan)}, "T_world_camera is [[NaN, NaN"),
    "no rotation": ({"T_world_camera": np.diag([1, 1, 2, 1])}, "expected a rigid transform (4, 4)"),
    "two poses": ({"T_world_camera": np.tile(np.eye(4), (2, 1, 1))}, "expected a rigid transform"),
    "mirrored": ({"T_base_flange": np.diag([1, 1, -1, 1])}, "T_base_flange is [[1.0"),
    "NaN joint": ({"joints": [0, np.nan]}, "joints[1] is NaN, expected a finite number"),
    "truth": ({"T_world_camera_true": None}, "T_world_camera_true is missing, expected it for all"),
}


@pytest.mark.parametrize("case", BAD_FRAMES)
def test_a_bad_frame_leaves_no_trace(case: str, small: Any) -> None:
    changes, message = BAD_FRAMES[case]
    writer = DatasetWriter.resume(small.path)
    before = tree(small.path)
    with pytest.raises(DatasetError, match=re.escape(f"{small.path}: frame 3: ")) as error:
        writer.add_frame(**small.frame(3) | changes)
    assert message in str(error.value) and "\n" not in str(error.value)
    assert tree(small.path) == before
    assert writer.add_frame(**small.frame(3)) == 3  # and the writer goes on
    assert verify(small.path) == []


def test_clouds_have_finite_float32_points(tmp_path: Path) -> None:
    writer = DatasetWriter.create(tmp_path / "c", {"sensor": {"kind": "cloud", "origin": False}})
    for cloud, message in (
        (np.ones((3, 2)), "cloud of shape (3, 2), expected (n, 3)"),
        (np.full((1, 3), np.inf), "does not fit float32"),
        (np.full((1, 3), 1e39), "does not fit float32"),
    ):
        with pytest.raises(DatasetError, match=re.escape(message)):
            writer.add_frame(stamp=0, cloud=cloud, T_world_camera=np.eye(4))
    with pytest.raises(DatasetError, match="rgb given with a cloud"):
        writer.add_frame(
            stamp=0, cloud=np.ones((1, 3)), rgb=np.zeros((1, 1, 3)), T_world_camera=np.eye(4)
        )
    dataset = Dataset.open(writer.path)
    assert (dataset.name, dataset.sensor.origin, len(dataset)) == ("c", False, 0)


def test_create_needs_room_and_a_good_header(small: Any, tmp_path: Path) -> None:
    header = small.header()
    with pytest.raises(DatasetError, match=rf"{small.path}: not empty, expected no folder or an"):
        DatasetWriter.create(small.path, header)
    with pytest.raises(DatasetError, match="not a folder"):
        DatasetWriter.create(small.path / "dataset.json", header)
    with pytest.raises(
        DatasetError, match=r"poses_true\.txt/x: Not a directory, expected to be able"
    ):
        DatasetWriter.create(small.path / "poses_true.txt" / "x", header)
    header["sensor"]["width"] = 0
    with pytest.raises(DatasetError, match=r"sensor\.width is 0"):
        DatasetWriter.create(tmp_path / "new", header)
    for bad in ({"sensor": {1, 2}}, {"sensor": np.ones(3)}, {"a": np.nan}):
        with pytest.raises(DatasetError, match="header is no JSON"):
            DatasetWriter.create(tmp_path / "new", bad)
    assert not (tmp_path / "new").exists()
    # what a crash inside `create` leaves is room enough
    DatasetWriter.create(tmp_path / "new", small.header())
    (tmp_path / "new" / "dataset.json").unlink()
    (tmp_path / "new" / ".dataset.json.12.part").write_text("{")
    assert len(DatasetWriter.create(tmp_path / "new", small.header())) == 0


def test_a_second_writer_is_noticed(small: Any) -> None:
    one, other = DatasetWriter.resume(small.path), DatasetWriter.resume(small.path)
    one.add_frame(**small.frame(3))
    with pytest.raises(DatasetError, match="another program writes to it"):
        other.add_frame(**small.frame(4))
    one.add_frame(**small.frame(4))
    assert len(Dataset.open(small.path)) == 5 and verify(small.path) == []


def test_markers_must_be_seen_in_frames_that_are_there(small: Any) -> None:
    writer = DatasetWriter.resume(small.path)
    for frame, p in ((3, np.ones(3)), (0, np.array([1, np.nan, 1])), (0, np.ones(2))):
        with pytest.raises(DatasetError, match=r"markers\.json: "):
            writer.write_markers([Marker("a", np.zeros(3), ((frame, p),))])
    writer.write_markers([Marker("a", np.arange(3.0), ((2, np.ones(3)), (0, np.zeros(3))))])
    (marker,) = Dataset.open(small.path).markers()
    assert marker.name == "a" and [frame for frame, _ in marker.observations] == [2, 0]
    np.testing.assert_array_equal(marker.p_world, [0, 1, 2])


@contextlib.contextmanager
def full_disk(largest_file: int) -> Iterator[None]:
    """No file may grow beyond this many bytes: a write stops in the middle, as on a full disk."""
    resource = pytest.importorskip("resource", reason="no limits on this platform")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("file", ["poses_measured.txt", "frames.jsonl"])
def test_a_full_disk_stops_the_writer_and_resume_goes_on(small: Any, file: str) -> None:
    writer = DatasetWriter.resume(small.path)
    size = (small.path / file).stat().st_size
    if file == "poses_measured.txt":  # the limit holds for all files: make this one the largest
        size += 2000
        small.content(file, "#" + " " * 1999 + "\n" + (small.path / file).read_text())
        size = (small.path / file).stat().st_size
    with full_disk(size + 10), pytest.raises(DatasetError, match="expected to be able to write"):
        writer.add_frame(**small.frame(3))
    assert (small.path / file).stat().st_size == size  # no half line stays
    assert len(Dataset.open(small.path)) == 3 and verify(small.path) == []
    with pytest.raises(DatasetError, match="an earlier write failed, expected Dataset"):
        writer.add_frame(**small.frame(3))
    writer = DatasetWriter.resume(small.path)
    assert writer.add_frame(**small.frame(3)) == 3
    assert verify(small.path) == []


def test_durable_files_are_whole_or_as_before(tmp_path: Path) -> None:
    path = tmp_path / "a"
    assert durable.write_bytes(path, b"before") == hashlib.sha256(b"before").hexdigest()
    with full_disk(100), pytest.raises(OSError, match="File too large"):
        durable.write_bytes(path, b"x" * 200)
    assert path.read_bytes() == b"before" and [p.name for p in tmp_path.iterdir()] == ["a"]
    with full_disk(10), pytest.raises(OSError, match="only 4 of 6 bytes were written"):
        durable.append_line(path, "after")
    assert path.read_bytes() == b"before"
    with pytest.raises(ValueError, match="newline"):
        durable.append_line(path, "two\nlines")
    with pytest.raises(ValueError, match="not JSON compliant"):
        durable.write_json(path, {"a": float("nan")})
    durable.write_json(path, {"b": [1, "é"]})
    assert json.loads(path.read_text()) == {"b": [1, "é"]}


def test_poses_keep_twelve_digits(small: Any, tmp_path: Path) -> None:
    writer = DatasetWriter.create(tmp_path / "new", small.header())
    rng = np.random.default_rng(0)
    T = se3.make(se3.exp_so3(rng.normal(size=(20, 3))), rng.normal(size=(20, 3)) * 100)
    for i in range(20):
        stamp = 1.7e9 + i / 30
        writer.add_frame(stamp=stamp, depth=np.ones((6, 8)), T_world_camera=T[i])
    dataset = Dataset.open(writer.path)
    np.testing.assert_allclose(dataset.T_world_camera_measured, T, atol=1e-12)
    assert dataset.stamps.tolist() == [1.7e9 + i / 30 for i in range(20)]
    assert dataset.T_world_camera_true is None
