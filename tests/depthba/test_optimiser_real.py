"""The registration on the datasets that lie beside the checkout, where they do."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

import depthba
from depthba import se3
from depthba.dataset import Dataset
from depthba.options import Options
from depthba.result import Result
from depthba.trajectory import write_tum

SHARED = Path(__file__).parents[3] / "shared"


def opened(name: str) -> Dataset:
    if not (SHARED / "data" / name).is_dir():
        pytest.skip(f"{SHARED.name}/data/{name} is not beside this checkout")
    return Dataset.open(SHARED / "data" / name)


def scores(dataset: Dataset, T_world_camera: np.ndarray, folder: Path) -> dict[str, float]:
    """Return what the independent scorer says of poses: spread and point to plane, m."""
    tool = SHARED / "tools" / "score.py"
    if not tool.is_file():
        pytest.skip(f"{SHARED.name}/tools/score.py is not beside this checkout")
    write_tum(folder / "poses.txt", np.asarray(dataset.stamps), T_world_camera)
    command = [
        sys.executable,
        tool,
        dataset.path,
        folder / "poses.txt",
        "--cell",
        "0.005",
        "--json",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout)["map"]
    return found


def largest_move(result: Result) -> float:
    moved = result.T_world_camera - result.T_world_camera_start
    return float(np.linalg.norm(moved[:, :3, 3], axis=1).max())


def test_bumpy_reaches_the_noise() -> None:
    dataset = opened("bumpy-a")
    result = depthba.register(dataset)
    truth = dataset.T_world_camera_true
    assert truth is not None
    error = np.abs(se3.difference(se3.align_first(result.T_world_camera, truth), truth)[1:])
    assert result.trusted
    assert error[:, :3].mean() < 0.0002 and error[:, 3:].mean() < 0.0004


def test_a_map_coarser_than_rubble_makes_up_no_pattern_and_no_patches() -> None:
    """Relief that a map cannot hold mimics a fixed pattern, which grew to 867 m; poses went along.

    Quadrics over as much of the rubble as such a map's cells hold turned the frames, too.
    """
    dataset = opened("rock-field").subset(range(10))
    truth = dataset.T_world_camera_true
    assert truth is not None
    off = np.random.default_rng(0).standard_normal((10, 6)) * np.repeat([0.03, 0.02], 3)
    start = se3.retract(truth, off * (np.arange(10) > 0)[:, None])
    frames = tuple(replace(f, T_world_camera=T) for f, T in zip(dataset.frames, start, strict=True))
    result = depthba.register(
        replace(dataset, frames=frames), Options(resolution=0.05, prior_t=0.03, prior_r=0.02)
    )
    error = np.abs(se3.difference(se3.align_first(result.T_world_camera, truth), truth)[1:])
    assert result.trusted and result.fixed_pattern == 0.0
    assert error[:, :3].mean() < 0.0003 and error[:, 3:].mean() < 0.0001


def test_a_pattern_that_leaves_larger_residuals_is_put_back() -> None:
    """One of 1.5 m fitted walls that a coarse map cannot hold; cameras went 85 mm off with it."""
    dataset = opened("realsense-box").subset(range(0, 25, 2))
    options = Options(resolution=0.02, most_points=100_000)
    result = depthba.register(dataset, options)
    assert result.fixed_pattern == 0.0 and result.refused_pattern > 0.0
    # the cameras stand where they do if no pattern is looked for
    plain = depthba.register(dataset, replace(options, fixed_pattern=False))
    apart = result.T_world_camera[:, :3, 3] - plain.T_world_camera[:, :3, 3]
    assert np.linalg.norm(apart, axis=1).max() <= 0.0005
    assert largest_move(result) <= 0.020


TABLE = (-0.45, 0.05, -0.6, -0.05, -0.1, 0.3)


@pytest.mark.slow
def test_tray_is_aligned_and_does_not_slide(tmp_path: Path) -> None:
    """A bare table under a tray: frames could slide along it without anything to tell."""
    dataset = opened("ur5-tabletop-tray")
    result = depthba.register(dataset, Options(roi=TABLE))
    found = scores(dataset, result.T_world_camera, tmp_path)
    assert found["z_mad_median_m"] <= 0.00125
    assert found["p2plane_median_m"] <= 0.0015
    assert largest_move(result) <= 0.050
    assert not result.trusted and any("turn about z" in w.name for w in result.weak)


@pytest.mark.slow
def test_last_digits_of_the_start_move_the_tray_by_less_than_is_stated() -> None:
    """Patches alone had let frames slide by whatever these were: up to 37 mm apart."""
    dataset = opened("ur5-tabletop-tray")
    found, deviations = [], np.zeros(len(dataset))
    for seed in range(3):
        off = 1e-11 * np.random.default_rng(seed).standard_normal((len(dataset), 6))
        off[0] = 0.0
        start = se3.retract(dataset.T_world_camera_measured, off)
        pairs = zip(dataset.frames, start, strict=True)
        frames = tuple(replace(f, T_world_camera=T) for f, T in pairs)
        result = depthba.register(replace(dataset, frames=frames), Options(roi=TABLE))
        found.append(result.T_world_camera[:, :3, 3])
        own = np.diagonal(result.covariance).reshape(-1, 6)
        deviations = np.sqrt(own[:, :3].sum(axis=1))
    for one, other in combinations(found, 2):
        apart = np.linalg.norm(one - other, axis=1)
        assert (apart <= 1.5 * deviations).all(), apart / np.maximum(deviations, 1e-9)


@pytest.mark.slow
def test_box_is_aligned_though_its_walls_hold_two_heights(tmp_path: Path) -> None:
    dataset = opened("realsense-box")
    result = depthba.register(dataset)
    start = scores(dataset, result.T_world_camera_start, tmp_path)
    found = scores(dataset, result.T_world_camera, tmp_path)
    assert found["z_mad_median_m"] <= 0.0041
    assert found["p2plane_median_m"] <= start["p2plane_median_m"]
    assert largest_move(result) <= 0.015
