"""Calibration with a board, from images on disk to files and exit status."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import sim
from depthba import se3
from depthba.boards import Board
from depthba.cli import main
from depthba.dataset import Dataset
from tests.rig.board_problems import X, error
from tests.rig.board_scene import write_board


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_board(tmp_path_factory.mktemp("board") / "board")


def printed(capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    return dict(json.loads(capsys.readouterr().out))


def test_from_images_to_all_that_is_left_behind(
    board: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    out = tmp_path / "run"
    assert main(["calibrate", str(board.path), "--out", str(out), "--json"]) == 0
    said = printed(capsys)
    assert said["verdict"] == "converged" and said["method"] == "board"
    degrees, mm = error(np.array(said["T_flange_camera"]))
    assert degrees < 0.05 and mm < 0.25
    covariance = np.array(said["covariance"])
    delta = se3.difference(said["T_flange_camera"], X)
    assert delta @ np.linalg.solve(covariance, delta) < 22
    np.testing.assert_allclose(said["sigma_mm"], 1e3 * np.sqrt(np.diag(covariance)[:3]))
    kept = json.loads((out / "hand_eye.json").read_text())
    assert {key: said[key] for key in kept} == kept
    assert [frame["frame"] for frame in kept["frames"]] == list(board.ids)
    for name in ("reprojections.png", "residuals.png", "coverage.png"):
        picture = cv2.imread(str(out / name))
        assert picture is not None and picture.std() > 5
        assert f"]({name})" in (out / "report.md").read_text()
    assert not [p.name for p in out.iterdir() if p.name.startswith(".")]

    entities = {str(c.entity_path) for c in RrdReader(str(out / "run.rrd")).stream()}
    assert {"/board", "/image", "/next/sight", "/cameras/0/sight"} <= entities

    # the depth road's start is read from the same file, and the poses by the arm follow from it
    copy = tmp_path / "copy"
    shutil.copytree(board.path, copy)
    found = out / "hand_eye.json"
    assert main(["calibrate", str(copy), "--apply", "--from", str(found)]) == 0
    dataset = Dataset.open(copy)
    flange = np.stack([f.T_base_flange for f in dataset if f.T_base_flange is not None])
    np.testing.assert_allclose(
        dataset.poses("arm"), flange @ np.array(said["T_flange_camera"]), atol=1e-9
    )


def test_charuco_by_its_words_and_both_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    board = Board.parse("charuco:8x5x0.04")
    one = write_board(tmp_path / "one", board, count=6, named=False, seed=1)
    other = write_board(tmp_path / "other", board, count=6, named=False, seed=2)
    words = ["--board", "charuco:8x5x0.04", "--json"]
    assert main(["calibrate", str(one.path), *words, "--out", str(tmp_path / "a")]) == 0
    alone = printed(capsys)
    first = tmp_path / "a" / "hand_eye.json"
    out = ["--out", str(tmp_path / "b")]
    assert main(["calibrate", str(other.path), *words, *out, "--combine", str(first)]) == 0
    both = printed(capsys)
    assert both["method"] == "board+board"
    degrees, mm = error(np.array(both["T_flange_camera"]))
    assert degrees < 0.1 and mm < 0.5
    assert (np.array(both["sigma_mm"]) < np.array(alone["sigma_mm"])).all()

    moved = json.loads(first.read_text())
    moved["T_flange_camera"][0][3] += 0.005
    (tmp_path / "moved.json").write_text(json.dumps(moved))
    out = ["--out", str(tmp_path / "c")]
    words = [*words, *out, "--combine", str(tmp_path / "moved.json")]
    assert main(["calibrate", str(other.path), *words]) == 1
    said = capsys.readouterr()
    assert "disagree by" in said.err and said.out == ""
    assert not (tmp_path / "c").exists()


def test_one_line_says_what_is_wrong(
    board: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two = tmp_path / "two"
    write_board(two, count=2)
    three = tmp_path / "bare"
    write_board(three, count=3, named=False)
    missing = str(tmp_path / "no.json")
    for words, expected in (
        ([str(two)], "2 frames, but hand-eye calibration needs at least 3"),
        ([str(three)], "names no board, expected it there or --board"),
        ([str(three), "--board", "20x15x0.03"], "0 of 3 frames show the board of 20 x 15"),
        ([str(board.path), "--board", "10x7x30"], "square_m 30: expected metres"),
        ([str(board.path), "--board", "10x7"], "expected inner corners along x and y"),
        ([str(board.path), "--board", "10x7x0.03", "--from-depth"], "no --from-depth beside it"),
        ([str(board.path), "--robot-sigma", "1", "-1"], "expected two numbers above 0"),
        ([str(board.path), "--from", missing], "expected --apply beside it"),
        ([str(board.path), "--apply", "--from", missing], "no.json"),
    ):
        assert main(["calibrate", *words, "--out", str(tmp_path / "run")]) == 1
        said = capsys.readouterr()
        assert expected in said.err.splitlines()[-1], said.err
        assert said.out == "" and not (tmp_path / "run").exists()


def test_inverted_poses_end_with_status_3_and_no_number(
    board: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = tmp_path / "wrong"
    shutil.copytree(board.path, wrong)
    lines = [json.loads(line) for line in (wrong / "frames.jsonl").read_text().splitlines()]
    for line in lines:
        line["T_base_flange"] = se3.inverse(line["T_base_flange"]).tolist()
    (wrong / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    out = tmp_path / "run"
    assert main(["calibrate", str(wrong), "--out", str(out)]) == 3
    said = capsys.readouterr().out
    assert "inconsistent" in said.splitlines()[0] and "T_flange_base" in said.splitlines()[0]
    assert "translation" not in said and "rotation  " not in said
    kept = json.loads((out / "hand_eye.json").read_text())
    assert kept["T_flange_camera"] is None and kept["trusted"] is False
    assert main(["calibrate", str(wrong), "--apply", "--from", str(out / "hand_eye.json")]) == 1
    assert not (wrong / "poses_arm.txt").exists()


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["handeye-board", "handeye-charuco"])
def test_rendered_boards(scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = sim.generate(scene, tmp_path / "set", sim.GenerateOptions(seed=3))
    truth = Dataset.open(dataset).calibration()
    assert truth is not None
    assert main(["calibrate", str(dataset), "--out", str(tmp_path / "run"), "--json"]) == 0
    said = printed(capsys)
    degrees, mm = error(np.array(said["T_flange_camera"]), np.array(truth["T_flange_camera_true"]))
    assert degrees < 0.05 and mm < 0.25
