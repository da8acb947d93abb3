"""Reading a dataset: all that the format allows opens, and gives what was written."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from depthba import se3
from depthba.dataset import Dataset, DatasetWriter, verify
from depthba.errors import DatasetError
from depthba.ply import ply_bytes


def test_all_comes_back(small: Any) -> None:
    dataset = Dataset.open(small.path)
    assert (dataset.name, dataset.map_frame, dataset.seed, len(dataset)) == ("small", "auto", 3, 3)
    assert dataset.warnings == () and verify(small.path) == []
    assert dataset.ids == (0, 1, 2) and [frame.id for frame in dataset] == [0, 1, 2]
    np.testing.assert_array_equal(dataset.stamps, [10, 10.5, 11])
    noise = dataset.sensor.noise
    assert noise is not None and (noise.sigma_m, noise.at_m, noise.power) == (0.002, 1, 2)
    assert noise.along == "z" and dataset.sensor.origin
    truth = dataset.T_world_camera_true
    assert truth is not None
    for i, frame in enumerate(dataset):
        written = small.frame(i)
        z = written["depth"]
        expected = np.where((z >= 0.5 - 1e-9) & (z <= 3.0 + 1e-9), z, np.nan)
        np.testing.assert_allclose(frame.depth(), expected, atol=0.0005001)
        assert frame.depth().dtype == np.float32
        rgb = frame.rgb()
        assert rgb is not None and rgb.dtype == np.uint8
        np.testing.assert_array_equal(rgb, written["rgb"])
        points = frame.points()
        assert points.shape == (np.isfinite(expected).sum(), 3) and points.dtype == np.float32
        assert frame.joints is not None and frame.joints.tolist() == written["joints"]
        T = written["T_world_camera"]
        np.testing.assert_allclose(frame.T_world_camera, T, atol=1e-12)
        np.testing.assert_allclose(dataset.T_world_camera_measured[i], T, atol=1e-12)
        np.testing.assert_allclose(se3.difference(truth[i], T), [0.01, 0, 0, 0, 0, 0.01], atol=1e-9)
    (marker,) = dataset.markers()
    assert marker.name == "origin" and marker.observations[0][0] == 0
    assert dataset.calibration() is None


def _stamps_fall(small: Any) -> None:
    small.record(1, stamp=11.0)
    small.record(2, stamp=10.5)


LEGAL: dict[str, Callable[[Any], None]] = {
    "optional keys left out": lambda d: d.change(
        name=None, seed=None, sensor__noise=None, sensor__depth_min=None,
        sensor__depth_max=None, sensor__model=None, sensor__distortion=None,
    ),
    "optional frame keys left out": lambda d: d.record(1, rgb=None, joints=None),
    "unknown keys": lambda d: d.change(extra={"a": [1]}, noise="a sentence", sensor__extra=1),
    "unknown frame keys": lambda d: d.record(2, source_id=151),
    "no truth": lambda d: d.content("poses_true.txt", None),
    "other poses and files": lambda d: d.content("poses_other.txt", "not poses at all"),
    "blank lines": lambda d: d.append("frames.jsonl", b"  \n\n"),
    "ids with gaps": lambda d: d.record(2, id=7),
    "stamps that fall": _stamps_fall,
    "calibration": lambda d: d.content("calibration.json", '{"board": {"columns": 9, "rows": 6}}'),
    "a quaternion off by under 1e-6": lambda d: d.line(
        "poses_measured.txt", 2, "10.5 0 0 0 0 0 0 1.0000009"
    ),
    "stamps that differ by under 1e-6": lambda d: d.line(
        "poses_measured.txt", 2, "10.5000009 0 0 0 0 0 0 1"
    ),
    "poses without a frame": lambda d: d.append("poses_measured.txt", b"99 0 0 0 0 0 0 1\n"),
}  # fmt: skip


@pytest.mark.parametrize("case", LEGAL)
def test_legal(case: str, small: Any) -> None:
    LEGAL[case](small)
    dataset = Dataset.open(small.path)
    assert len(dataset) == 3 and dataset.warnings == ()
    for frame in dataset:
        frame.points()
        frame.rgb()
    assert verify(small.path) == []


def test_a_path_may_be_given_through_links(small: Any) -> None:
    link = small.path.parent / "link"
    link.symlink_to(small.path)
    assert len(Dataset.open(link)[0].points()) > 0
    shutil.move(small.path / "depth", small.path / "images")  # a link that stays inside is fine
    (small.path / "depth").symlink_to("images")
    assert verify(link) == []


def test_one_frame_without_any_measurement_is_legal(pristine: Any, tmp_path: Path) -> None:
    one = pristine.write(tmp_path / "one", frames=1)
    one.content("depth/000000.png", one.png(np.zeros((6, 8), np.uint16)), frame=0)
    dataset = Dataset.open(one.path)
    assert len(dataset) == 1 and verify(one.path) == []
    assert np.isnan(dataset[0].depth()).all()
    assert dataset[0].points().shape == (0, 3)


def test_no_frame_yet_opens_with_a_warning(pristine: Any, tmp_path: Path) -> None:
    none = pristine.write(tmp_path / "none", frames=0)
    dataset = Dataset.open(none.path)
    assert len(dataset) == 0 and dataset.T_world_camera_measured.shape == (0, 4, 4)
    assert "no frame in it" in dataset.warnings[0] and verify(none.path) == []


def test_the_range_is_inclusive_and_exact_at_the_largest_value(small: Any) -> None:
    small.change(sensor__depth_scale=5e-05, sensor__depth_min=0.3, sensor__depth_max=3.27675)
    pixels = np.zeros((6, 8), np.uint16)
    pixels[0, :5] = [65535, 65534, 6000, 5999, 1]
    small.content("depth/000000.png", small.png(pixels), frame=0)
    z = Dataset.open(small.path)[0].depth()
    np.testing.assert_allclose(z[0, :3], [3.27675, 3.2767, 0.3], rtol=1e-7)
    assert np.isnan(z[0, 3:]).all()


@pytest.mark.parametrize("file", ["frames.jsonl", "poses_true.txt"])
def test_a_truncated_last_line_is_dropped_with_a_warning(small: Any, file: str) -> None:
    tail = {"frames.jsonl": b'{"id": 3, "stamp": 11.5, "de\xff', "poses_true.txt": b"11.5 0 0"}
    small.append(file, tail[file])
    dataset = Dataset.open(small.path)
    assert len(dataset) == 3 and verify(small.path) == []
    (warning,) = dataset.warnings
    assert file in warning and "dropped the truncated last line" in warning


def test_a_last_line_that_only_lacks_its_newline_counts(small: Any) -> None:
    for file in ("frames.jsonl", "poses_measured.txt"):
        small.content(file, (small.path / file).read_bytes().rstrip(b"\n"))
    dataset = Dataset.open(small.path)
    assert len(dataset) == 3 and dataset.warnings == ()


def test_clouds(small: Any, tmp_path: Path) -> None:
    sensor = {"kind": "cloud", "model": "scanner", "origin": True, "depth_max": 2.0}
    writer = DatasetWriter.create(tmp_path / "c", {"name": "c", "sensor": sensor})
    cloud = np.array([[0.1, 0.2, 1.0], [np.nan, 0, 0], [0.3, 0.4, 2.5], [-1, 0, 0.5]])
    writer.add_frame(stamp=0, cloud=cloud, T_world_camera=np.eye(4))
    writer.add_frame(stamp=1, cloud=np.zeros((0, 3)), T_world_camera=np.eye(4))
    clouds = type(small)(tmp_path / "c")
    dataset = Dataset.open(clouds.path)
    assert dataset.sensor.camera is None and dataset.sensor.origin and verify(clouds.path) == []
    np.testing.assert_allclose(dataset[0].points(), cloud[[0, 3]], rtol=1e-7)
    assert dataset[1].points().shape == (0, 3) and dataset[1].rgb() is None
    with pytest.raises(DatasetError, match="frame 0: has no 'depth', only 'cloud'"):
        dataset[0].depth()
    for data, message in (
        (ply_bytes([[0, np.inf, 1]]), r"point 0 is \(0, inf, 1\), expected finite coordinates"),
        (ply_bytes([[0, 1, 1]])[:-1], "11 bytes of data for element 'vertex', expected 1 x 12"),
    ):
        clouds.content("cloud/000001.ply", data, frame=1)
        with pytest.raises(DatasetError, match=rf"cloud/000001\.ply: frame 1: {message}"):
            Dataset.open(clouds.path)[1].points()
        assert [fault.frame for fault in verify(clouds.path)] == [1]


def test_poses_by_name(small: Any) -> None:
    shutil.copy(small.path / "poses_true.txt", small.path / "poses_other.txt")
    dataset = Dataset.open(small.path)
    truth = dataset.T_world_camera_true
    assert truth is not None
    np.testing.assert_array_equal(dataset.poses("other"), truth)
    with pytest.raises(
        DatasetError, match="no poses 'none', expected one of measured, other, true"
    ):
        dataset.poses("none")
    small.line("poses_true.txt", 3, "# gone")
    with pytest.raises(DatasetError, match=r"poses_true\.txt: frame 2: no pose with stamp 11"):
        _ = Dataset.open(small.path).T_world_camera_true
