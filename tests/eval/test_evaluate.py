"""Evaluating runs: agreement with an independent scorer, what is written, what is refused."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from depthba import se3, trajectory
from depthba.cli import main
from depthba.dataset import Dataset
from depthba.depth_map import DepthMap
from depthba.errors import DatasetError, OptionError, RunError
from depthba.options import Options
from depthba.result import Result
from depthba.run_folder import RunFolder
from depthba.stored_run import Run
from eval.evaluate import evaluate, judge
from eval.metrics import consistency, pose_metrics
from eval.verbs import evaluate as verb

Floats = NDArray[np.float64]
Roi = tuple[float, float, float, float, float, float] | None

SHARED = Path(__file__).parents[3] / "shared"
SCORER = SHARED / "tools" / "score.py"


def by_name(run: Path, **more: Any) -> dict[str, float]:
    return {m.name: m.value for m in evaluate(run, **more)}


def scored(dataset: Path, poses: Path, *words: str) -> dict[str, Any]:
    command = [sys.executable, str(SCORER), str(dataset), str(poses), "--map", "--json", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def first_frames(source: Path, path: Path, count: int) -> Dataset:
    """Copy the first frames of a dataset: the whole of it would take the tests too long."""
    path.mkdir()
    lines = (source / "frames.jsonl").read_text().splitlines(keepends=True)[:count]
    (path / "frames.jsonl").write_text("".join(lines))
    for kind in ("depth", "rgb"):
        for line in lines:
            if kind in (record := json.loads(line)):
                (path / kind).mkdir(exist_ok=True)
                shutil.copy(source / record[kind], path / record[kind])
    for file in (*source.glob("poses_*.txt"), source / "dataset.json"):
        shutil.copy(file, path)
    return Dataset.open(path)


def run_near_measured_poses(path: Path, data: Dataset, result: Result, roi: Roi) -> Path:
    """A run of a real dataset whose estimate is millimetres away from the measured poses."""
    n = len(data)
    T = data.T_world_camera_measured.copy()
    T[1:, :3, 3] += np.random.default_rng(0).normal(size=(n - 1, 3)) * 1e-3
    unseen = np.full((2, 2), np.nan)
    empty = DepthMap(unseen, (0.0, 0.0), 0.01, np.eye(4), np.zeros((2, 2), np.int64), unseen)
    made = replace(
        result,
        frame_ids=tuple(range(n)),
        stamps=tuple(float(s) for s in data.stamps),
        T_world_camera=T,
        T_world_camera_start=data.T_world_camera_measured,
        depth_map=empty,
        depth_map_start=empty,
        covariance=np.zeros((6 * n, 6 * n)),
        history=(),
    )
    folder = RunFolder.create(path)
    folder.write(made, Options(roi=roi), data)
    return folder.path


@pytest.mark.skipif(not SCORER.exists(), reason="the scorer does not lie beside the checkout")
@pytest.mark.parametrize(
    ("name", "roi"),
    [
        ("bumpy-a", None),
        ("ur5-tabletop-tray", (-0.45, 0.05, -0.6, -0.05, -0.1, 0.3)),
        ("realsense-box", None),  # the map's axes come from the viewing directions
    ],
)
def test_the_independent_scorer_agrees(name: str, roi: Roi, tmp_path: Path, result: Result) -> None:
    if not (SHARED / "data" / name).exists():
        pytest.skip(f"{name} does not lie beside the checkout")
    data = first_frames(SHARED / "data" / name, tmp_path / "data", 3)
    run = run_near_measured_poses(tmp_path / "run", data, result, roi)
    crop = "none" if roi is None else ",".join(map(str, roi))
    theirs = scored(tmp_path / "data", run / "poses.txt", f"--crop={crop}")
    judged = judge(run)
    ours = {m.name: m.value for m in judged.metrics}
    found = theirs["map"]
    assert judged.shared_cells == found["cells_2plus"] and judged.pairs == found["pairs"]
    pairs = [
        ("spread_median", found["z_mad_median_m"]),
        ("spread_p90", found["z_mad_p90_m"]),
        ("point_to_plane_median", found["p2plane_median_m"]),
        ("point_to_plane_worst_pair", found["p2plane_worst_pair_m"]),
    ]
    if "translation_m" in theirs:
        pairs += [
            (f"{part}_{kind}", theirs[key][kind])
            for part, key in (("translation", "translation_m"), ("rotation", "rotation_rad"))
            for kind in ("mae", "rmse")
        ]
        pairs += [("ate_rmse", theirs["ate_rmse_m"])]
        pairs += [("rotation_max", theirs["rotation_rad"]["max_abs"])]
        pairs += [("translation_rmse_y", theirs["translation_m"]["rmse_axis"][1])]
    for metric, value in pairs:
        assert_allclose(ours[metric], value, atol=1e-9, rtol=0, err_msg=metric)


def test_start_and_estimate_stand_side_by_side(run: Path) -> None:
    found = by_name(run)
    assert found["start_translation_mae"] > 5e-3 > 1e-3 > found["translation_mae"] > 1e-5
    assert found["start_spread_median"] > 10 * found["spread_median"] > 0
    assert found["start_point_to_plane_median"] > 10 * found["point_to_plane_median"] > 0
    assert 0.2 < found["nees_per_dof"] < 3.0

    saved = json.loads((run / "metrics.json").read_text())
    assert saved["metrics"]["ate_rmse"] == {
        "value": found["ate_rmse"],
        "unit": "m",
        "better": "lower",
    }
    assert saved["start"]["ate_rmse"]["value"] == found["start_ate_rmse"]
    page = (run / "report.md").read_text()
    for words in ("(map.png)", "yaw", "too little overlap", "Translation, mean absolute error"):
        assert words in page
    assert str(run.parent) not in page


def test_the_region_of_interest_counts(run: Path) -> None:
    everywhere = judge(run)
    (run / "config.yaml").write_text("roi: [0.0, 0.6, -0.2, 0.2, -1.0, 1.0]\n")
    inside = judge(run)
    assert inside.cell == everywhere.cell
    assert 0.1 < inside.shared_cells / everywhere.shared_cells < 0.6


def test_another_truth_and_another_dataset_win(
    run: Path, dataset: Dataset, near_truth: Floats, tmp_path: Path
) -> None:
    file = tmp_path / "other.txt"
    trajectory.write_tum(file, dataset.stamps, near_truth)
    assert by_name(run, truth=file)["translation_mae"] == pytest.approx(0.0, abs=1e-9)

    saved = json.loads((run / "result.json").read_text())
    saved["dataset"]["path"] = str(tmp_path / "gone")
    (run / "result.json").write_text(json.dumps(saved))
    with pytest.raises(RunError, match="gone is not there"):
        evaluate(run)
    assert by_name(run, dataset=dataset.path)["translation_mae"] > 0


@pytest.fixture
def wobbly(run: Path, dataset: Dataset) -> Floats:
    """True poses (N, 4, 4) in another world; gives the run's first frame a covariance as well."""
    assert dataset.T_world_camera_true is not None
    with np.load(run / "covariance.npz") as arrays:
        saved = dict(arrays)
    n = len(dataset)
    A = np.random.default_rng(5).normal(size=(6 * n, 6 * n)) * np.tile([1e-4] * 3 + [1e-5] * 3, n)
    saved["full"] = A.T @ A / n
    np.savez(run / "covariance.npz", **saved)
    T_file_world = se3.retract(np.eye(4), np.array([1.0, -2.0, 0.5, 0.4, -0.3, 1.0]))
    return np.asarray(T_file_world @ dataset.T_world_camera_true)


def test_truth_at_other_stamps_is_interpolated(
    run: Path, dataset: Dataset, wobbly: Floats, tmp_path: Path
) -> None:
    exact, dense = tmp_path / "exact.txt", tmp_path / "dense.txt"
    trajectory.write_tum(exact, dataset.stamps, wobbly)
    # each pose lies a quarter of the way between two stamps, to which it moves evenly
    step = np.array([4e-3, -2e-3, 1e-3, 2e-2, 1e-2, -3e-2])
    around = [
        (stamp + share * 0.01, se3.retract(T, share * step))
        for stamp, T in zip(dataset.stamps, wobbly, strict=True)
        for share in (-1.25, -0.25, 0.75, 1.75)
    ]
    trajectory.write_tum(dense, [s for s, _ in around], [T for _, T in around])
    expected, found = judge(run, truth=exact), judge(run, truth=dense)
    assert len(found.true_frames) == len(dataset) and found.nees_dof == expected.nees_dof
    for ours, theirs in zip(found.metrics, expected.metrics, strict=True):
        if not ours.name.startswith("marker"):
            assert_allclose(ours.value, theirs.value, rtol=1e-6, atol=1e-9, err_msg=ours.name)


def test_only_frames_that_have_truth_count(
    run: Path, dataset: Dataset, wobbly: Floats, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    some, n = np.array([1, 2, 4]), len(dataset)
    file = tmp_path / "some.txt"
    trajectory.write_tum(file, dataset.stamps[some], wobbly[some])
    whole = judge(run)
    assert verb.run(verb.Arguments(runs=(run,), truth=file)) == 0
    for text in (capsys.readouterr().out, (run / "report.md").read_text()):
        told = " ".join(text.split())
        assert "frame 1 put onto it" in told and f"3 of {n} frames have truth" in told
    saved = json.loads((run / "metrics.json").read_text())
    assert saved["frames_with_truth"] == [1, 2, 4] and saved["nees_dof"] == 12

    opened = Run.open(run)
    assert opened.covariance is not None
    T = opened.T_world_camera
    expected = {m.name: m.value for m in pose_metrics(T[some], wobbly[some])}
    moved = wobbly[1] @ se3.inverse(T[1]) @ T  # by hand: onto the first frame with truth
    errors = (moved[[2, 4], :3, 3] - wobbly[[2, 4], :3, 3]).ravel()
    assert saved["metrics"]["translation_rmse"]["value"] == pytest.approx(
        np.sqrt(np.mean(errors**2))
    )
    for name, value in expected.items():
        assert saved["metrics"][name]["value"] == pytest.approx(value), name
    rows = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in some])
    honest = consistency(T[some], wobbly[some], opened.covariance[np.ix_(rows, rows)])
    assert saved["metrics"]["nees_per_dof"]["value"] == pytest.approx(honest.nees_per_dof)
    # what needs no truth is told of all frames
    assert saved["pairs"] == whole.pairs
    with pytest.raises(RunError, match=f"3 of {n} frames have truth; the bound is for all"):
        evaluate(run, truth=file, bound=True)


def test_truth_of_other_times_is_refused_in_one_line(
    run: Path, dataset: Dataset, wobbly: Floats, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    n, first, last = len(dataset), dataset.stamps[0], dataset.stamps[-1]
    file = tmp_path / "later.txt"
    trajectory.write_tum(file, dataset.stamps + 1000.005, wobbly)
    assert main(["evaluate", str(run), "--truth", str(file)]) == 1
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    for words in (
        f"{first + 1000.005:.6f} to {last + 1000.005:.6f} s",
        f"{first:.6f} to {last:.6f} s",
        f"none of {n} have",
    ):
        assert words in told[0]
    between = tmp_path / "between.txt"
    trajectory.write_tum(between, dataset.stamps + 0.3, wobbly)  # around, but far apart
    with pytest.raises(RunError, match=r"within 0\.1 s on both sides"):
        evaluate(run, truth=between)
    assert len(judge(run, truth=between, max_gap=2.0).true_frames) == n - 1
    trajectory.write_tum(file, dataset.stamps[2:3], wobbly[2:3])
    with pytest.raises(RunError, match=f"1 of {n} has"):
        evaluate(run, truth=file)
    file.write_text("".join("1 0 0 0 0 1 0 0 0 0 1 0\n" for _ in range(n)))
    with pytest.raises(DatasetError, match="without stamps"):
        evaluate(run, truth=file)


def test_without_truth_only_agreement_is_judged(
    run: Path, dataset: Dataset, tmp_path: Path
) -> None:
    blind = tmp_path / "blind"
    shutil.copytree(dataset.path, blind, ignore=shutil.ignore_patterns("poses_true.txt"))
    found = by_name(run, dataset=blind)
    assert "translation_mae" not in found and "nees_per_dof" not in found
    assert found["spread_median"] > 0
    assert "There is no truth" in (run / "report.md").read_text()


def test_what_does_not_fit_is_refused(run: Path, dataset: Dataset, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="cell"):
        evaluate(run, cell=-1.0)
    with pytest.raises(DatasetError):
        evaluate(run, truth=tmp_path / "nowhere.txt")
    with pytest.raises(OptionError, match="max_gap"):
        evaluate(run, max_gap=float("nan"))
    with pytest.raises(RunError, match="no such run folder"):
        evaluate(tmp_path / "nothing")


def test_the_verb_prints_one_object_or_a_table(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert verb.run(verb.Arguments(runs=(run,), json=True)) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["runs"][0]["metrics"]["translation_mae"]["unit"] == "m"
    assert verb.run(verb.Arguments(runs=(run,))) == 0
    told = capsys.readouterr().out
    assert "Translation, mean absolute error" in told
    assert "against the truth, frame 0 put onto it." in told and "frames have truth" not in told
    assert verb.run(verb.Arguments(runs=())) == 2
