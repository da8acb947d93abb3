"""Hand-eye calibration from depth alone, from a dataset on disk to the exit status."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from depthba import se3
from depthba.dataset import Dataset
from depthba.errors import OptionError
from rig.hand_eye.from_depth import HandEye, Options, calibrate
from tests.rig.arm_scene import WRONG, X, write_arm

OPTIONS = Options(resolution=0.012, threads=1)
WORDS = ("--from-depth", "--resolution", "0.012", "--threads", "1")


def depthba(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "depthba", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_arm(tmp_path_factory.mktemp("arm") / "arm")


def found(dataset: Dataset) -> HandEye:
    assert dataset.T_flange_camera is not None
    return calibrate(dataset, dataset.T_flange_camera, OPTIONS)


def test_finds_x_from_ten_millimetres_and_a_degree_away(arm: Dataset) -> None:
    result = found(arm)
    error = se3.difference(result.T_flange_camera, X)
    assert result.status == "converged"
    assert np.linalg.norm(error[:3]) < 0.3e-3
    assert np.linalg.norm(error[3:]) < np.radians(0.03)
    # no scene tells anything for certain: the covariance owns up to the error
    assert error @ np.linalg.solve(result.covariance, error) / 6 < 3
    assert np.sqrt(np.diag(result.covariance))[:3].max() < 0.3e-3


def test_equal_inputs_give_equal_bits(arm: Dataset) -> None:
    one, other = found(arm), found(arm)
    np.testing.assert_array_equal(one.T_flange_camera, other.T_flange_camera)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_a_gantry_gets_its_tilt_and_no_place(tmp_path: Path) -> None:
    result = found(write_arm(tmp_path / "gantry", axes=""))
    error = se3.difference(result.T_flange_camera, X)
    assert result.status == "weak"
    assert "never turned" in result.reason
    assert {o.name for o in result.open} >= {"x", "y"} or len(result.open) == 3
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


def test_refuses_values_that_make_no_sense(arm: Dataset) -> None:
    for options in (Options(start_error=(0.01, 0.0)), Options(resolution=-1), Options(threads=0)):
        with pytest.raises(OptionError, match="expected"):
            calibrate(arm, X, options)


def test_verb_prints_one_json_object_and_leaves_the_run(arm: Dataset, tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = depthba("calibrate", arm.path, *WORDS, "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert printed["verdict"] == "converged"
    assert np.shape(printed["T_flange_camera"]) == (4, 4)
    assert len(printed["sigma_mm"]) == len(printed["sigma_deg"]) == 3
    kept = json.loads((out / "hand_eye.json").read_text())
    assert kept["T_flange_camera"] == printed["T_flange_camera"]
    assert np.shape(kept["covariance"]) == (6, 6)
    assert len(kept["frames"]) == len(arm)
    again = depthba("calibrate", arm.path, *WORDS, "--out", out)
    assert again.returncode == 1 and "not empty" in again.stderr


def test_verb_ends_with_three_where_the_motions_do_not_do(tmp_path: Path) -> None:
    gantry = write_arm(tmp_path / "gantry", axes="")
    start = tmp_path / "start.json"
    start.write_text(json.dumps({"T_flange_camera": se3.retract(X, 0.2 * WRONG).tolist()}))
    words = ("calibrate", gantry.path, *WORDS, "--out", tmp_path / "run", "--start", start)
    done = depthba(*words)
    assert done.returncode == 3, done.stderr
    first = done.stdout.splitlines()[0]
    assert "weak" in first and "mounting tilt" in first


def test_verb_says_in_one_line_what_is_missing(arm: Dataset, tmp_path: Path) -> None:
    bare = write_arm(tmp_path / "bare", frames=3, flange=False)
    start = tmp_path / "start.json"
    start.write_text(json.dumps(X.tolist()))
    wrong = tmp_path / "wrong.json"
    wrong.write_text('{"T": 1}')
    for words, expected in (
        ((arm.path,), "--from-depth"),
        ((bare.path, "--from-depth"), "no T_flange_camera"),
        ((bare.path, "--from-depth", "--start", start), "frame 0 has no T_base_flange"),
        ((arm.path, "--from-depth", "--start", wrong), "no T_flange_camera in it"),
    ):
        done = depthba("calibrate", *words, "--out", tmp_path / "run")
        assert done.returncode == 1
        assert expected in done.stderr.splitlines()[-1]
        assert "Traceback" not in done.stderr
        assert not (tmp_path / "run").exists()
