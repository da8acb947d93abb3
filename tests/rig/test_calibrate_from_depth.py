"""Hand-eye calibration from depth alone, from a dataset on disk to the exit status."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from depthba import se3
from depthba.cli import main
from depthba.dataset import Dataset
from depthba.errors import OptionError
from rig.hand_eye.depth.calibration import HandEye, Options, calibrate
from tests.rig.arm_scene import WRONG, X, write_arm

OPTIONS = Options(resolution=0.016, threads=1)
WORDS = ("--from-depth", "--resolution", "0.016", "--threads", "1")


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_arm(tmp_path_factory.mktemp("arm") / "arm")


def found(dataset: Dataset) -> HandEye:
    assert dataset.T_flange_camera is not None
    return calibrate(dataset, dataset.T_flange_camera, OPTIONS)


def test_finds_x_from_ten_millimetres_and_a_degree_away(
    arm: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    words = ["calibrate", str(arm.path), *WORDS, "--out", str(out)]
    assert main([*words, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["verdict"] == "converged"
    error = se3.difference(printed["T_flange_camera"], X)
    assert np.linalg.norm(error[:3]) < 0.3e-3
    assert np.linalg.norm(error[3:]) < np.radians(0.03)
    covariance = np.array(printed["covariance"])
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(printed["sigma_mm"], 1e3 * sigma[:3])
    np.testing.assert_allclose(printed["sigma_deg"], np.degrees(sigma[3:]))
    # the covariance owns up to the error, and is worth having
    assert error @ np.linalg.solve(covariance, error) / 6 < 3
    assert sigma[:3].max() < 0.3e-3
    kept = json.loads((out / "hand_eye.json").read_text())
    assert kept["T_flange_camera"] == printed["T_flange_camera"]
    assert len(kept["frames"]) == len(arm)
    assert main(words) == 1
    assert "not empty" in capsys.readouterr().err
    # equal inputs give equal bits
    np.testing.assert_array_equal(found(arm).covariance, covariance)


def test_a_gantry_gets_its_tilt_and_no_place(tmp_path: Path) -> None:
    result = found(write_arm(tmp_path / "gantry", axes=""))
    error = se3.difference(result.T_flange_camera, X)
    assert result.status == "weak"
    assert "never turned" in result.reason
    assert len(result.open) == 3
    assert np.linalg.norm(error[3:]) < np.radians(0.05)
    sigma = np.sqrt(np.diag(result.covariance))
    # what is open stays with the start, and says so
    assert np.all(sigma[:3] > 0.9 * OPTIONS.start_error[0])
    assert np.all(np.abs(error[:3]) < 2 * np.abs(WRONG[:3]))


def test_parallel_axes_leave_the_shift_along_them(tmp_path: Path) -> None:
    result = found(write_arm(tmp_path / "parallel", axes="z"))
    assert result.status == "weak"
    assert "parallel axis (0.00, 0.00, 1.00)" in result.reason
    assert [o.name for o in result.open] == ["z"]
    error = se3.difference(result.T_flange_camera, X)
    assert np.linalg.norm(error[:2]) < 1e-3


@pytest.mark.parametrize("fault", ["a centimetre off", "one frame late"])
def test_flange_poses_of_something_else_are_named(tmp_path: Path, fault: str) -> None:
    arm = write_arm(tmp_path / "arm", frames=8)
    flange = np.stack([frame.T_base_flange for frame in arm])
    if fault == "one frame late":
        flange = np.roll(flange, -1, axis=0)
    else:
        rng = np.random.default_rng(0)
        flange = se3.retract(flange, 0.01 * rng.standard_normal((8, 6)))
    frames = zip(arm.frames, flange, strict=True)
    result = found(replace(arm, frames=tuple(replace(f, T_base_flange=T) for f, T in frames)))
    assert result.status == "inconsistent"
    assert "do not fit the frames" in result.reason
    if fault != "one frame late":
        assert result.beliefs.robot_t == pytest.approx(0.01, rel=0.3)


def test_refuses_values_that_make_no_sense(arm: Dataset) -> None:
    for options in (Options(start_error=(0.01, 0.0)), Options(resolution=-1), Options(threads=0)):
        with pytest.raises(OptionError, match="expected"):
            calibrate(arm, X, options)


def test_verb_says_first_that_the_motions_do_not_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gantry = write_arm(tmp_path / "gantry", axes="", frames=5)
    start = tmp_path / "start.json"
    start.write_text(json.dumps({"T_flange_camera": se3.retract(X, 0.2 * WRONG).tolist()}))
    words = ["calibrate", str(gantry.path), *WORDS, "--out", str(tmp_path / "run")]
    assert main([*words, "--start", str(start)]) == 3
    first = capsys.readouterr().out.splitlines()[0]
    assert "weak" in first and "mounting tilt" in first


def test_verb_says_in_one_line_what_is_missing(
    arm: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = str(write_arm(tmp_path / "bare", frames=3, flange=False).path)
    start = tmp_path / "start.json"
    start.write_text(json.dumps(X.tolist()))
    wrong = tmp_path / "wrong.json"
    wrong.write_text('{"T": 1}')
    for words, expected in (
        ([str(arm.path)], "--from-depth"),
        ([bare, "--from-depth"], "no T_flange_camera"),
        ([bare, "--from-depth", "--start", str(start)], "frame 0 has no T_base_flange"),
        ([str(arm.path), "--from-depth", "--start", str(wrong)], "no T_flange_camera in it"),
        ([str(arm.path), "--from-depth", "--threads", "0"], "expected 1 or more"),
    ):
        assert main(["calibrate", *words, "--out", str(tmp_path / "run")]) == 1
        said = capsys.readouterr()
        assert expected in said.err.splitlines()[-1]
        assert said.out == ""
        assert not (tmp_path / "run").exists()
