"""Session files: what they may say, and what is said of those that are wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from depthba.errors import OptionError
from rig.cameras.realsense import RealSenseOptions
from rig.session.options import plain
from rig.session.reading import read_session, read_taught
from rig.session.record import differences
from tests.rig.sessions import HAND_EYE, ROOT, write

EXAMPLES = sorted((ROOT / "docs" / "sessions").glob("*.yaml"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_is_a_session(path: Path) -> None:
    session = read_session(path)
    assert session.poses and np.shape(session.hand_eye) == (4, 4)
    assert json.loads(json.dumps(plain(session)))["camera"]["kind"] == session.camera.kind


def test_there_is_an_example_for_every_kind_of_rig() -> None:
    found = {(read_session(p).rig.kind, read_session(p).camera.kind) for p in EXAMPLES}
    assert {("ur", "zed"), ("ur", "realsense"), ("ur", "simulated")} <= found
    assert ("modbus", "genicam") in found


def test_options_arrive_as_the_driver_has_them(tmp_path: Path) -> None:
    (tmp_path / "hand_eye.json").write_text(json.dumps({"T_flange_camera": HAND_EYE}))
    path = write(
        tmp_path / "s.yaml",
        camera={"kind": "realsense", "options": {"serial": "12345"}},
        hand_eye="hand_eye.json",
        rig__options={"host": "10.0.0.5", "calibration": "arm.conf", "frequency": 250},
    )
    session = read_session(path)
    assert session.hand_eye == tuple(map(tuple, HAND_EYE))
    assert isinstance(session.camera.options, RealSenseOptions)
    options = session.rig.options
    assert options.calibration == (tmp_path / "arm.conf").resolve() and options.frequency == 250.0


WRONG: list[tuple[str, dict[str, Any], str]] = [
    ("settle", {"motion__settle": "soon"}, r"s\.yaml:\d+: motion\.settle: is 'soon', expected a f"),
    ("nan", {"motion__settle": float("nan")}, r"motion\.settle: is '\.nan', expected a finite"),
    ("key", {"motion__sped": 1.0}, r"motion\.sped: unknown key, choose from: move, speed, acc"),
    ("kind", {"camera__kind": "kinect"}, r"camera\.kind: unknown camera 'kinect'; choose"),
    ("rig", {"rig__kind": "abb"}, r"rig\.kind: is 'abb', expected one of: ur, modbus, grbl"),
    ("option", {"camera__options": {"sice": [1, 2]}}, r"camera\.options\.sice: unknown key.*size"),
    ("host", {"rig__options": {}}, r"rig\.options\.host: is missing, expected text"),
    ("no options", {"rig__options": None}, r":\d+: rig\.options\.host: is missing"),
    ("limits", {"limits": None}, r"s\.yaml:\d+: limits: is missing, expected a map"),
    ("box", {"limits__camera": [1, 0, 0, 1, 0, 1]}, r"limits: camera \[1\.0, 0\..* each min below"),
    ("rigid", {"hand_eye": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "not rigid"),
    ("file", {"hand_eye": "not_there.json"}, r"hand_eye: .*not_there\.json: No such file"),
    ("two", {"poses": [{"joints": [], "dome": None, "taught": {"file": "x"}}]}, r"joints and tau"),
    ("none", {"poses": []}, r"poses: none, expected one or more"),
    ("steps", {"poses": [{"positions": [[0, 0]]}]}, r"poses\[0\]: positions for a rig of kind ur"),
    ("grid", {"poses": [{"grid": {"x": [0, 1]}}]}, r"poses\[0\]\.grid\.y: is missing"),
    ("tilt", {"poses": [{"dome": {"centre": [0, 0, 0], "radius": 1, "tilts_deg": [0],
                                  "counts": [1, 2]}}]}, r"poses\[0\]\.dome: counts \[1, 2\]"),
    ("bool", {"retries": True}, r"retries: is 'true', expected a whole number"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "said"), [row[1:] for row in WRONG], ids=[w[0] for w in WRONG])
def test_what_is_wrong_is_told_with_its_line(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(OptionError, match=said):
        read_session(write(tmp_path / "s.yaml", **changes))


def test_the_line_is_that_of_the_value(tmp_path: Path) -> None:
    path = write(tmp_path / "s.yaml", motion={"settle": 1, "speed": "fast"})
    row = next(
        number
        for number, line in enumerate(path.read_text().splitlines(), start=1)
        if "fast" in line
    )
    with pytest.raises(OptionError, match=rf"s\.yaml:{row}: motion\.speed"):
        read_session(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty, expected a mapping of: rig, camera"),
        ("a: 1\nrig: [\n  b: c: d", r"s\.yaml:3: not YAML"),
        ("- 1", r"s\.yaml:1: is a list of 1, expected a mapping"),
        ("retries: 1\nretries: 2", r"s\.yaml:2: retries: is there twice"),
        ("\x00", "not YAML"),
    ],
)
def test_what_is_no_session_is_said_so(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "s.yaml").write_text(text)
    with pytest.raises(OptionError, match=said):
        read_session(tmp_path / "s.yaml")


def test_taught_poses(tmp_path: Path) -> None:
    file = tmp_path / "taught.txt"
    file.write_text("# where it was driven to\n0 90, 0 0 0 180\n\n1 2 3 4 5 6 # here\n")
    found = read_taught(file, 6, degrees=True)
    np.testing.assert_allclose(found, np.radians([[0, 90, 0, 0, 0, 180], [1, 2, 3, 4, 5, 6]]))
    file.write_text("1 2 3\n1 2 nan\n")
    with pytest.raises(OptionError, match=r"taught\.txt:2: '1 2 nan', expected 3 numbers"):
        read_taught(file, 3, degrees=False)


def test_differences_are_listed_by_key() -> None:
    before = {"a": [1, {"b": 2}], "c": "x", "gone": 1}
    now = {"a": [1, {"b": 3}], "c": "x", "new": None}
    assert differences(before, now) == ["a[1].b: 2 before, 3 now", "gone: 1 before, null now"]
