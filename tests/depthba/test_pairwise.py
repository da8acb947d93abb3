"""The pairwise start: from far off into reach, and honest about what it cannot place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import depthba
from depthba import se3
from depthba.dataset import Dataset
from depthba.options import Options
from depthba.pairwise import PairwiseStart, pairwise_poses
from tests.depthba.analytic_scene import Floats, pose_errors, truth_of, write_scene

FAR_T, FAR_R = 0.1, 0.05
SPACING = 0.012


def rough(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return height and gradient of waves whose directions and lengths nothing repeats."""
    rng = np.random.default_rng(5)
    z, along_x, along_y = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    for _ in range(14):
        direction, length = rng.uniform(0, np.pi), rng.uniform(0.12, 0.5)
        kx, ky = 2 * np.pi / length * np.array([np.cos(direction), np.sin(direction)])
        phase, height = rng.uniform(0, 2 * np.pi), 0.018 * length
        z = z + height * np.sin(kx * x + ky * y + phase)
        slope = height * np.cos(kx * x + ky * y + phase)
        along_x, along_y = along_x + kx * slope, along_y + ky * slope
    return z, along_x, along_y


def far(truth: Floats, seed: int) -> Floats:
    error = np.random.default_rng(seed).standard_normal((len(truth), 6))
    error *= np.repeat([FAR_T, FAR_R], 3)
    error[0] = 0.0
    return se3.retract(truth, error)


def started(dataset: Dataset, T: Floats, threads: int = 1) -> PairwiseStart:
    clouds = [frame.points() for frame in dataset]
    sigma_t, sigma_r = np.full(3, FAR_T), np.full(3, FAR_R)
    return pairwise_poses(clouds, T, sigma_t, sigma_r, SPACING, threads)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("pairwise") / "scene"
    return write_scene(folder, surface=rough, frames=6, noise=0.0005)


@pytest.mark.parametrize("seed", range(3))
def test_far_starts_come_within_reach(scene: Dataset, seed: int) -> None:
    truth = truth_of(scene)
    begun = far(truth, seed)
    start = started(scene, begun)
    off_t, off_r = pose_errors(start.T_world_camera, truth)
    assert pose_errors(begun, truth)[0] > 0.05
    assert off_t < 0.01 and off_r < 0.02, "the reach of the optimiser"
    assert not start.left
    assert (start.T_world_camera[0] == begun[0]).all()


def test_registration_starts_from_pairs(tmp_path: Path) -> None:
    dataset = write_scene(
        tmp_path / "scene",
        surface=rough,
        noise=0.0005,
        shift={2: np.array([0.12, -0.1, 0.05]), 4: np.array([-0.1, 0.13, -0.08])},
    )
    options = Options(init="pairwise", prior_t=FAR_T, prior_r=FAR_R, threads=1)
    result = depthba.register(dataset, options)
    off_t, off_r = pose_errors(result.T_world_camera, truth_of(dataset))
    assert off_t < 0.001 and off_r < 0.001


def test_equal_input_gives_equal_bits(scene: Dataset) -> None:
    begun = far(truth_of(scene), 1)
    one, two = started(scene, begun), started(scene, begun, threads=2)
    assert (one.T_world_camera == two.T_world_camera).all()
    assert one.pairs == two.pairs


def test_any_world_frame(scene: Dataset) -> None:
    begun = far(truth_of(scene), 2)
    T_new_world = se3.make(se3.exp_so3([0.7, -1.1, 0.4]), [3.0, -2.0, 5.0])
    here, there = started(scene, begun), started(scene, T_new_world @ begun)
    off_t, off_r = pose_errors(T_new_world @ here.T_world_camera, there.T_world_camera)
    assert off_t < 0.004 and off_r < 0.004


def test_a_frame_that_matches_no_other_is_left_and_told(tmp_path: Path) -> None:
    dataset = write_scene(tmp_path / "scene", surface=rough, frames=5, noise=0.0005, empty=[3])
    begun = far(truth_of(dataset), 3)
    clouds = [frame.points() for frame in dataset]
    begun[4, :3, 3] += [40.0, 0.0, 0.0]  # far from all others
    start = pairwise_poses(clouds, begun, np.full(3, FAR_T), np.full(3, FAR_R), SPACING, 1)
    assert start.left == (3, 4)
    assert (start.T_world_camera[3:] == begun[3:]).all()
    assert all(p.used or p.fault for p in start.pairs)
    others = [0, 1, 2]
    assert pose_errors(start.T_world_camera[others], truth_of(dataset)[others])[0] < 0.01


def test_no_points_at_all() -> None:
    nothing = [np.zeros((0, 3), np.float32)] * 3
    T = np.repeat(np.eye(4)[None], 3, axis=0)
    assert pairwise_poses(nothing, T, np.ones(3), np.ones(3), 0.01, 1).left == (1, 2)


def test_a_bare_plane_is_not_matched(tmp_path: Path) -> None:
    def slab(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        return 0.05 * x, np.full_like(x, 0.05), np.zeros_like(x)

    dataset = write_scene(tmp_path / "scene", surface=slab, frames=4, noise=0.001)
    begun = far(truth_of(dataset), 0)
    start = started(dataset, begun)
    assert start.left == (1, 2, 3)
    assert (start.T_world_camera == begun).all()
