"""Registration of analytic surfaces through the public entry: what it recovers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import depthba
from depthba import se3
from depthba.dataset import Dataset
from depthba.depth_map import DepthMap
from depthba.options import Options
from depthba.result import Result
from depthba.trajectory import write_tum
from tests.depthba.analytic_scene import pose_errors, truth_of, write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Five frames with 1 mm of noise, off by 10 mm and 10 mrad per axis."""
    return write_scene(tmp_path_factory.mktemp("bumpy") / "scene")


@pytest.fixture(scope="module")
def result(scene: Dataset) -> Result:
    return depthba.register(scene)


def deviations(errors: np.ndarray, covariance: np.ndarray) -> float:
    """Return the root mean square of errors (N, 6) in units of their covariance; frame 0 is 0."""
    e = errors[1:].ravel()
    return float(np.sqrt(e @ np.linalg.solve(covariance[6:, 6:], e) / len(e)))


def relative(T: np.ndarray) -> np.ndarray:
    return np.asarray(se3.inverse(T[0]) @ T)


def misfit(scene: Dataset, D: DepthMap, T: np.ndarray, c: float) -> float:
    """Return the mean Geman-McClure cost of vertical distances, m^2; off the map it is c^2."""
    costs = []
    for frame, pose in zip(scene, D.T_map_world @ T, strict=True):
        q = frame.points() @ pose[:3, :3].T + pose[:3, 3]
        at = ((q[:, :2] - D.origin) / D.spacing).T[::-1]
        e = q[:, 2] - map_coordinates(D.heights, at, order=1, cval=np.nan)
        costs.append(np.where(np.isfinite(e), e**2 * c**2 / (e**2 + c**2), c**2))
    return float(np.mean(np.concatenate(costs)))


def test_recovers_within_the_noise(scene: Dataset, result: Result) -> None:
    start_t, start_r = pose_errors(scene.T_world_camera_measured, truth_of(scene))
    end_t, end_r = pose_errors(result.T_world_camera, truth_of(scene))
    assert start_t > 0.005 and start_r > 0.005
    assert end_t < 0.0003 and end_t < start_t / 15
    assert end_r < 0.0006 and end_r < start_r / 15
    assert result.status == "converged" and result.trusted and result.weak == ()
    np.testing.assert_array_equal(result.T_world_camera[0], scene.T_world_camera_measured[0])
    # truncation at the robust scale takes a little off
    assert 0.0007 < result.sigma < 0.0012
    assert all(f.held == "" for f in result.frames[1:]) and result.frames[0].held


def test_recovers_exactly_without_noise(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", noise=0.0)
    end_t, end_r = pose_errors(depthba.register(scene).T_world_camera, truth_of(scene))
    # depth is stored in steps of 20 micrometres
    assert end_t < 2e-5 and end_r < 3e-5


def test_paper_preset_recovers(scene: Dataset) -> None:
    result = depthba.register(scene, Options(preset="paper", resolution=0.025))
    end_t, end_r = pose_errors(result.T_world_camera, truth_of(scene))
    assert end_t < 0.0003 and end_r < 0.0006
    assert result.trusted and {h.phase for h in result.history} == {"quadratic"}
    assert {h.spacing for h in result.history} == {0.025}


def test_history_and_map_tell_what_happened(scene: Dataset) -> None:
    seen: list[depthba.Iteration] = []
    result = depthba.register(scene, callback=seen.append)
    assert tuple(seen) == result.history and len(seen) > 2
    assert [h.index for h in seen] == list(range(len(seen)))
    np.testing.assert_allclose(seen[-1].T_world_camera, result.T_world_camera, atol=1e-12)
    assert result.depth_map.spacing == seen[-1].spacing
    heights = result.depth_map.heights
    assert np.isfinite(heights).sum() > 500 and np.ptp(heights[np.isfinite(heights)]) < 0.1
    known = np.isfinite(result.depth_map.sigma)
    assert (known == np.isfinite(heights)).all() and result.depth_map.sigma[known].min() > 0


@pytest.fixture(scope="module")
def two_worlds(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Result]:
    """The same frames told in two world frames, where the registration chooses the map's."""
    folder = tmp_path_factory.mktemp("worlds")
    T = se3.make(se3.exp_so3([0.7, -1.1, 2.0]), [3.0, -5.0, 2.0])
    plain = write_scene(folder / "plain", map_frame="auto")
    moved = write_scene(folder / "moved", map_frame="auto", T_new_world=T)
    return depthba.register(plain), depthba.register(moved)


def test_any_world_frame_gives_the_same_poses_within_their_deviation(
    two_worlds: tuple[Result, Result],
) -> None:
    one, other = two_worlds
    apart = se3.difference(
        se3.align_first(other.T_world_camera, one.T_world_camera), one.T_world_camera
    )
    assert one.status == other.status == "converged"
    assert deviations(apart, one.covariance) < 1.0


def test_any_world_frame_gives_the_same_poses(two_worlds: tuple[Result, Result]) -> None:
    one, other = two_worlds
    np.testing.assert_allclose(
        relative(one.T_world_camera), relative(other.T_world_camera), atol=1e-6
    )


def test_start_does_not_matter(scene: Dataset, result: Result, tmp_path: Path) -> None:
    truth = truth_of(scene)
    write_tum(tmp_path / "truth.txt", np.asarray(scene.stamps), truth)
    other = depthba.register(scene, Options(init=str(tmp_path / "truth.txt")))
    apart = se3.difference(result.T_world_camera, other.T_world_camera)
    assert deviations(apart, result.covariance) < 0.3


def test_far_world_coordinates(tmp_path: Path, scene: Dataset, result: Result) -> None:
    """Coordinates of a national grid: a million metres from the origin."""
    T = se3.make(np.eye(3), [1e6, -1e6, 0.0])
    far = depthba.register(write_scene(tmp_path / "far", T_new_world=T))
    assert far.status == result.status
    end_t, end_r = pose_errors(se3.inverse(T) @ far.T_world_camera, truth_of(scene))
    assert end_t < 0.0003 and end_r < 0.0006


def test_same_input_same_bits(scene: Dataset) -> None:
    runs = [depthba.register(scene, Options(threads=2)) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].T_world_camera, runs[1].T_world_camera)
    np.testing.assert_array_equal(runs[0].depth_map.heights, runs[1].depth_map.heights)
    np.testing.assert_array_equal(runs[0].covariance, runs[1].covariance)
    single = depthba.register(scene, Options(threads=1))
    np.testing.assert_allclose(single.T_world_camera, runs[0].T_world_camera, atol=1e-9)
    np.testing.assert_allclose(single.depth_map.heights, runs[0].depth_map.heights, atol=1e-9)


def test_truth_as_start_stays(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", start_error=False)
    result = depthba.register(scene)
    end_t, end_r = pose_errors(result.T_world_camera, truth_of(scene))
    assert end_t < 0.0003 and end_r < 0.0006
    assert max(f.move_t for f in result.frames) < 0.001
    assert result.status != "no_better"
    c = 3.5 * result.sigma
    assert misfit(scene, result.depth_map, result.T_world_camera, c) <= misfit(
        scene, result.depth_map_start, result.T_world_camera_start, c
    )


def test_covariance(scene: Dataset, result: Result) -> None:
    cov = result.covariance
    assert cov.shape == (30, 30)
    np.testing.assert_array_equal(cov, cov.T)
    assert not cov[:6].any()
    values = np.linalg.eigvalsh(cov[6:, 6:])
    assert values.min() > 0
    # centimetres were the start's, a fraction of a millimetre is what the data leave
    assert np.sqrt(np.diag(cov)[6:]).max() < 0.001


def test_errors_agree_with_the_covariance(tmp_path: Path) -> None:
    """Chi-square over seeds: errors in units of what the covariance promises."""
    found = []
    for seed in range(6):
        scene = write_scene(tmp_path / f"scene-{seed}", seed=seed)
        result = depthba.register(scene)
        truth = truth_of(scene)
        found.append(deviations(se3.difference(result.T_world_camera, truth), result.covariance))
    assert 0.7 < np.sqrt(np.mean(np.square(found))) < 1.5
