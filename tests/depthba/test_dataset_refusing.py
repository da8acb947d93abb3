"""What is wrong with a dataset is told in one line that says where, what and what was expected."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from depthba.dataset import Dataset, verify
from depthba.errors import DatasetError

Change = Callable[[Any], object]


def png(pixels: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1].tobytes())


def _link_out(small: Any) -> None:
    target = small.path.parent / "elsewhere.png"
    shutil.move(small.path / "depth/000001.png", target)
    (small.path / "depth/000001.png").symlink_to(target)


GOOD_PNG = png(np.full((6, 8), 1000, np.uint16))
FLIPPED = bytearray(GOOD_PNG)
FLIPPED[45] ^= 1
NOT_RIGID = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
BAD_METADATA: dict[str, tuple[Change, str]] = {
    "no dataset.json": (lambda d: d.content("dataset.json", None), "no dataset.json in it"),
    "not JSON": (lambda d: d.content("dataset.json", "{"), "dataset.json: not JSON"),
    "a list": (
        lambda d: d.content("dataset.json", "[]"),
        "dataset.json: it is [], expected an object",
    ),
    "NaN": (lambda d: d.change(sensor__fx=float("nan")), "dataset.json: NaN is in it"),
    "overflow": (
        lambda d: d.content("dataset.json", '{"a": 1e999}'),
        "dataset.json: 1e999 is in it",
    ),
    "deep": (lambda d: d.content("dataset.json", "[" * 100000), "dataset.json: not JSON"),
    "twice": (lambda d: d.content("dataset.json", '{"a": 1, "a": 2}'), "key 'a' is there twice"),
    "format": (
        lambda d: d.change(format="other"),
        "format is \"other\", expected 'depthba-dataset'",
    ),
    "no version": (lambda d: d.change(version=None), "key 'version' is missing"),
    "newer": (lambda d: d.change(version=2), "version is 2, expected 1: it takes a newer depthba"),
    "version 1.0": (lambda d: d.change(version="1"), 'version is "1", expected an integer'),
    "kind": (
        lambda d: d.change(sensor__kind="sonar"),
        "sensor.kind is \"sonar\", expected 'depth' or 'cloud'",
    ),
    "no size": (lambda d: d.change(sensor__width=None), "key 'width' is missing"),
    "size": (
        lambda d: d.change(sensor__height=0),
        "sensor.height is 0, expected an integer of at least 1",
    ),
    "focal length": (
        lambda d: d.change(sensor__fy=-1),
        "sensor.fy is -1, expected a finite number above 0",
    ),
    "bool": (lambda d: d.change(sensor__cx=True), "sensor.cx is true, expected a number"),
    "scale": (lambda d: d.change(sensor__depth_scale=0), "sensor.depth_scale is 0, expected"),
    "distortion": (lambda d: d.change(sensor__distortion=[0] * 4), "expected a list of 5 numbers"),
    "range": (
        lambda d: d.change(sensor__depth_max=0.4),
        "sensor.depth_max is 0.4, expected a finite number",
    ),
    "along": (
        lambda d: d.change(sensor__noise={"sigma_m": 1, "along": "x"}),
        "expected 'range' or 'z'",
    ),
    "map frame": (
        lambda d: d.change(map_frame="base"),
        "map_frame is \"base\", expected 'world' or 'auto'",
    ),
    "pose noise": (
        lambda d: d.change(pose_noise={"sigma_t_m": [1, 1]}),
        "pose_noise.sigma_t_m is [1, 1]",
    ),
    "hand-eye": (lambda d: d.change(T_flange_camera=NOT_RIGID), "T_flange_camera is [[1, 0, 0, 0]"),
    "no frames.jsonl": (lambda d: d.content("frames.jsonl", None), "frames.jsonl: no such file"),
    "a line in the middle": (
        lambda d: d.line("frames.jsonl", 1, '{"id": 1,'),
        "frames.jsonl: line 2: not JSON",
    ),
    "a list as frame": (
        lambda d: d.line("frames.jsonl", 1, "[]"),
        "frames.jsonl: line 2: it is []",
    ),
    "bytes": (
        lambda d: d.content("frames.jsonl", b"\xff\n{}\n"),
        "frames.jsonl: line 1: byte 0 is not UTF-8",
    ),
    "id twice": (
        lambda d: d.record(2, id=1),
        "frame 1: line 3: id 1 is there twice, expected ids that rise",
    ),
    "ids fall": (
        lambda d: d.record(0, id=5),
        "frame 1: line 2: id 1 follows id 5, expected ids that rise",
    ),
    "id": (lambda d: d.record(1, id="1"), 'line 2: id is "1", expected an integer of at least 0'),
    "no id": (lambda d: d.record(1, id=None), "line 2: key 'id' is missing"),
    "no stamp": (lambda d: d.record(1, stamp=None), "frame 1: key 'stamp' is missing"),
    "stamp": (lambda d: d.record(1, stamp=float("inf")), "line 2: Infinity is in it"),
    "same stamp": (
        lambda d: d.record(2, stamp=10.0),
        "frame 2: stamp 10.000000000 is that of frame 0 too",
    ),
    "joints": (
        lambda d: d.record(1, joints=[0, "x"]),
        'frame 1: joints[1] is "x", expected a number',
    ),
    "flange": (
        lambda d: d.record(1, T_base_flange=[[1]]),
        "frame 1: T_base_flange is [[1]], expected 4 rows",
    ),
    "no depth": (lambda d: d.record(1, depth=None), "frame 1: key 'depth' is missing"),
    "no hash": (lambda d: d.record(1, sha256={}), "frame 1: sha256 of 'depth' is missing"),
    "short hash": (
        lambda d: d.record(1, sha256={"depth": "ab"}),
        'frame 1: sha256.depth is "ab", expected 64',
    ),
    "absolute": (
        lambda d: d.record(1, depth="/etc/passwd"),
        'frame 1: path "/etc/passwd", expected one inside',
    ),
    "upwards": (
        lambda d: d.record(1, depth="depth/../../x.png"),
        'frame 1: path "depth/../../x.png", expected',
    ),
    "windows": (
        lambda d: d.record(1, depth="C:\\x.png"),
        'frame 1: path "C:\\\\x.png", expected one inside',
    ),
    "link out": (_link_out, 'frame 1: path "depth/000001.png" is a link out of the dataset'),
    "missing file": (
        lambda d: d.content("depth/000001.png", None),
        "depth/000001.png: frame 1: no such file",
    ),
    "a folder as file": (lambda d: d.record(1, depth="rgb"), "rgb: frame 1: no such file"),
    "no poses": (
        lambda d: d.content("poses_measured.txt", None),
        "poses_measured.txt: no such file",
    ),
    "no pose": (
        lambda d: d.line("poses_measured.txt", 2, "# gone"),
        "frame 1: no pose with stamp 10.500000000, expected one to 1e-06 s (the nearest is at 1",
    ),
    "two poses": (
        lambda d: d.line("poses_measured.txt", 3, "10.5 0 0 0 0 0 0 1"),
        "poses_measured.txt: frame 1: 2 poses",
    ),
    "NaN pose": (
        lambda d: d.line("poses_measured.txt", 2, "10.5 0 nan 0 0 0 0 1"),
        "poses_measured.txt: line 3: ty is nan",
    ),
    "not unit": (
        lambda d: d.line("poses_measured.txt", 2, "10.5 0 0 0 0 0 0 1.00001"),
        "poses_measured.txt: line 3: quaternion of length 1.00001, expected 1 to 1e-06",
    ),
    "NaN truth": (
        lambda d: d.line("poses_true.txt", 1, "10 0 0 inf 0 0 0 1"),
        "poses_true.txt: line 2: tz is inf",
    ),
}


@pytest.mark.parametrize("case", BAD_METADATA)
def test_open_refuses(case: str, small: Any) -> None:
    change, message = BAD_METADATA[case]
    change(small)
    with pytest.raises(DatasetError, match=re.escape(message)) as error:
        Dataset.open(small.path)
    assert str(error.value).startswith(str(small.path)) and "\n" not in str(error.value)
    faults = verify(small.path)
    if case in ("missing file", "a folder as file"):  # reading them words it in its own way
        assert [fault.frame for fault in faults] == [1]
    else:
        assert any(message in f"{small.path}: {fault}" for fault in faults), faults


BAD_IMAGES: dict[str, tuple[Change, str]] = {
    "other bytes": (lambda d: d.content("depth/000001.png", GOOD_PNG), "sha256 is "),
    "no PNG": (
        lambda d: d.content("depth/000001.png", b"hello", 1),
        "begins with b'hello', expected a PNG",
    ),
    "empty": (lambda d: d.content("depth/000001.png", b"", 1), "begins with b'', expected a PNG"),
    "cut off": (lambda d: d.content("depth/000001.png", GOOD_PNG[:-9], 1), "is cut off"),
    "bit flip": (
        lambda d: d.content("depth/000001.png", bytes(FLIPPED), 1),
        "'IDAT' has a wrong check sum",
    ),
    "8 bit": (
        lambda d: d.content("depth/000001.png", png(np.zeros((6, 8), np.uint8)), 1),
        "PNG of 8 bit grey, expected 16 bit grey",
    ),
    "colour": (
        lambda d: d.content("depth/000001.png", png(np.zeros((6, 8, 3), np.uint16)), 1),
        "PNG of 16 bit RGB, expected 16 bit grey",
    ),
    "size": (
        lambda d: d.content("depth/000001.png", png(np.zeros((8, 6), np.uint16)), 1),
        "PNG of 6 x 8 pixels, expected 8 x 6",
    ),
    "grey as colour": (
        lambda d: d.content("rgb/000001.png", png(np.zeros((6, 8), np.uint8)), 1),
        "PNG of 8 bit grey, expected 8 bit RGB",
    ),
    "with alpha": (
        lambda d: d.content("rgb/000001.png", png(np.zeros((6, 8, 4), np.uint8)), 1),
        "PNG of 8 bit RGB with alpha, expected 8 bit RGB",
    ),
    "size of colour": (
        lambda d: d.content("rgb/000001.png", png(np.zeros((6, 9, 3), np.uint8)), 1),
        "PNG of 9 x 6 pixels, expected 8 x 6",
    ),
}


@pytest.mark.parametrize("case", BAD_IMAGES)
def test_loading_refuses(case: str, small: Any, capfd: pytest.CaptureFixture[str]) -> None:
    change, message = BAD_IMAGES[case]
    change(small)
    frame = Dataset.open(small.path)[1]
    with pytest.raises(DatasetError, match=re.escape(message)) as error:
        frame.points()
        frame.rgb()
    assert re.match(rf"{small.path}/(depth|rgb)/000001\.png: frame 1: ", str(error.value))
    (fault,) = verify(small.path)
    assert fault.frame == 1 and message in fault.text
    assert capfd.readouterr().err == ""  # the decoder prints nothing of its own


def test_markers_and_calibration_are_checked(small: Any) -> None:
    seen = [{"frame": 9, "p_camera": [0, 0, 1]}, {"frame": 0, "p_camera": [0, 0]}]
    (small.path / "markers.json").write_text(
        json.dumps([{"name": "a", "p_world": [0, 0, 0], "observations": seen}])
    )
    (small.path / "calibration.json").write_text('{"board": {"rows": 0}, "T_base_board_true": 1}')
    with pytest.raises(DatasetError, match=r"'a' is seen in frame 9, which is not in the dataset"):
        Dataset.open(small.path).markers()
    with pytest.raises(DatasetError, match=r"calibration\.json: T_base_board_true is 1"):
        Dataset.open(small.path).calibration()
    assert [fault.file for fault in verify(small.path)] == ["markers.json"] * 2 + [
        "calibration.json"
    ] * 2


def test_verify_lists_every_fault_at_once(small: Any) -> None:
    small.change(map_frame="base", sensor__width=-1, sensor__fx="f")
    small.record(0, stamp=10.2, joints="x")
    small.content("depth/000001.png", b"x")
    small.content("rgb/000002.png", None)
    small.line("poses_true.txt", 2, "10.5 0 0 nan 0 0 0 1")
    found = {(fault.file, fault.frame) for fault in verify(small.path)}
    assert found == {
        ("dataset.json", None),
        ("frames.jsonl", 0),
        ("depth/000001.png", 1),
        ("rgb/000002.png", 2),
        ("poses_measured.txt", 0),
        ("poses_true.txt", None),
        ("poses_true.txt", 0),
        ("poses_true.txt", 1),
    }
    assert len([fault for fault in verify(small.path) if fault.file == "dataset.json"]) == 3


@contextlib.contextmanager
def unprivileged() -> Iterator[None]:
    """Root may read everything, so be nobody for a while."""
    root = os.geteuid() == 0
    if root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)


@pytest.mark.skipif(os.name == "nt", reason="permissions are POSIX's")
def test_what_may_not_be_read(small: Any) -> None:
    opened = Dataset.open(small.path)
    small.path.chmod(0)
    with unprivileged():
        with pytest.raises(DatasetError, match=r"Permission denied, expected a readable folder"):
            Dataset.open(small.path)
        assert len(verify(small.path)) == 1
        with pytest.raises(DatasetError, match=r"000001\.png: frame 1: Permission denied"):
            opened[1].depth()
    small.path.chmod(0o755)


def test_what_is_no_folder(small: Any) -> None:
    for path, message in (
        (small.path / "nowhere", "no such folder, expected a dataset"),
        (small.path / "frames.jsonl", "not a folder, expected a dataset"),
        (small.path / "depth", "no dataset.json in it, expected a dataset"),
    ):
        with pytest.raises(DatasetError, match=f"{path}: {message}"):
            Dataset.open(path)
        assert len(verify(path)) == 1


@settings(deadline=None, max_examples=200)
@given(
    st.sampled_from(["dataset.json", "frames.jsonl", "poses_measured.txt", "depth/000001.png"]),
    st.floats(0, 1, exclude_max=True),
    st.binary(max_size=4),
    st.integers(0, 4),
)
def test_damage_is_never_worse_than_a_known_error(
    pristine: Any, file: str, where: float, put: bytes, out: int
) -> None:
    whole = (pristine.path / file).read_bytes()
    at = int(where * len(whole))
    try:
        (pristine.path / file).write_bytes(whole[:at] + put + whole[at + out :])
        faults = verify(pristine.path)
        try:
            for frame in Dataset.open(pristine.path):
                frame.points()
                frame.rgb()
        except DatasetError as error:
            assert "\n" not in str(error)
            assert faults, error
    finally:
        (pristine.path / file).write_bytes(whole)


@pytest.mark.parametrize("file", ["dataset.json", "poses_measured.txt", "markers.json"])
def test_a_link_out_of_the_dataset_is_refused_wherever_it_stands(
    small: Any, tmp_path: Path, file: str
) -> None:
    (small.path / file).rename(tmp_path / "elsewhere")
    (small.path / file).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DatasetError, match=f"{file}.* is a link out of the dataset"):
        Dataset.open(small.path)
    assert len(verify(small.path)) == 1
