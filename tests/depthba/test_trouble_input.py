"""Numbers that mean nothing are refused, each in one line that names it."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import depthba
from depthba import cli
from depthba.dataset import Dataset
from depthba.errors import DatasetError, DepthbaError
from depthba.options import Options
from tests.depthba.analytic_scene import SIGMA_T
from tests.depthba.trouble_scenes import Views, look, write


def frozen(views: Views) -> Views:
    return views.but(depth=np.repeat(views.depth[:1], len(views.depth), axis=0))


def change(path: Path, **sensor: Any) -> None:
    header = json.loads((path / "dataset.json").read_text())
    header["sensor"] |= sensor
    (path / "dataset.json").write_text(json.dumps(header))


def other_size(path: Path) -> None:
    """Frame 1 gets a whole image of another size, listed as it should be."""
    lines = (path / "frames.jsonl").read_text().splitlines()
    record = json.loads(lines[1])
    png = cv2.imencode(".png", np.full((30, 40), 20000, np.uint16))[1].tobytes()
    (path / record["depth"]).write_bytes(png)
    record["sha256"]["depth"] = hashlib.sha256(png).hexdigest()
    lines[1] = json.dumps(record)
    (path / "frames.jsonl").write_text("\n".join(lines) + "\n")


def same_stamp(path: Path) -> None:
    text = (path / "frames.jsonl").read_text()
    (path / "frames.jsonl").write_text(text.replace('"stamp": 1.0', '"stamp": 0.0'))


def pose(path: Path, word: str) -> None:
    text = (path / "poses_measured.txt").read_text()
    lines = text.splitlines()
    lines[-1] = " ".join([*lines[-1].split()[:1], word, *lines[-1].split()[2:]])
    (path / "poses_measured.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        pytest.param(lambda p: change(p, fx=0.0), r"sensor\.fx is 0\.0", id="no focal length"),
        pytest.param(lambda p: change(p, fx=1e-300), r"fx 1e-300", id="points at infinity"),
        pytest.param(
            lambda p: change(p, fx=1e-9, fy=1e-9), r"check fx", id="a view of 180 degrees"
        ),
        pytest.param(
            lambda p: change(p, noise={"sigma_m": 1e-3, "at_m": 1e-3, "power": 1e6}),
            r"power 1e\+06 is inf m",
            id="infinite noise",
        ),
        pytest.param(other_size, r"frame 1: PNG of 40 x 30 pixels", id="another size"),
        pytest.param(same_stamp, r"stamp 0\.0+ is that of frame 0", id="stamp twice"),
        pytest.param(lambda p: pose(p, "nan"), r"tx is nan", id="pose that is no number"),
        pytest.param(lambda p: pose(p, "inf"), r"tx is inf", id="pose at infinity"),
    ],
)
def test_is_refused_by_the_library_and_by_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], None], named: str
) -> None:
    write(tmp_path / "scene", look(frames=2))
    spoil(tmp_path / "scene")
    with pytest.raises(DepthbaError, match=named) as caught:
        depthba.register(tmp_path / "scene", Options(threads=1))
    assert "\n" not in str(caught.value)
    out = tmp_path / "run"
    words = ["register", str(tmp_path / "scene"), "--out", str(out), "--threads", "1"]
    assert cli.main(words) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if "error:" in line]
    assert len(said) == 1 and re.search(named, said[0])
    assert not out.exists()


def test_images_that_are_all_one(tmp_path: Path) -> None:
    scene = write(tmp_path / "scene", frozen(look()))
    with pytest.raises(DatasetError, match=r"only frame 0 .* those of frame 0 to the last digit"):
        depthba.register(scene)


def test_the_command_line_says_that_a_result_is_not_to_be_trusted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views = look(frames=2)
    T = views.T_measured.copy()
    T[1, 0, 3] += 8.0
    write(tmp_path / "scene", views.but(T_measured=T))
    words = ["register", str(tmp_path / "scene"), "--out", str(tmp_path / "run"), "--json"]
    assert cli.main(words) == 3
    printed = json.loads(capsys.readouterr().out)
    assert not printed["trusted"] and printed["status"] == "weak"
    assert "no other frame sees" in printed["held"][0]["why"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write(tmp_path_factory.mktemp("live") / "scene", look(frames=3))


def test_live_registration_refuses_what_does_not_go_with_the_rest(scene: Dataset) -> None:
    first, second, third = scene
    camera = scene.sensor.camera
    assert camera is not None
    nowhere = second.T_world_camera.copy()
    nowhere[0, 3] = np.nan
    strangers = {
        "stamp 0.0+ is taken": replace(second, stamp=first.stamp),
        r"frame 1: was taken by .*fx 90\), expected .*fx 80\)": replace(
            second, sensor=replace(scene.sensor, camera=replace(camera, fx=90.0))
        ),
        "frame 1: its pose is": replace(second, T_world_camera=nowhere),
    }
    with depthba.Registration(scene.sensor, Options(threads=1), scene.map_frame) as live:
        live.add(first)
        for named, frame in strangers.items():
            with pytest.raises(DatasetError, match=named):
                live.add(frame)
        assert not live.add(second).held
        # the third shows what the second did
        update = live.add(replace(third, files=second.files))
        assert "those of frame 1 to the last digit" in update.held
        truth = scene.T_world_camera_true
        assert truth is not None
        np.testing.assert_allclose(update.T_world_camera[:2], truth[:2], atol=0.5 * SIGMA_T)
        result = live.result()
    assert result.status == "weak" and "frame 2 was held" in result.reason
