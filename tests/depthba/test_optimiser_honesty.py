"""What a registration must admit: open directions, frames without place, input without use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import depthba
from depthba import se3
from depthba.dataset import Dataset
from depthba.errors import DatasetError, OptionError
from depthba.options import Options
from depthba.result import Result
from depthba.trajectory import write_tum
from tests.depthba.analytic_scene import (
    SIGMA_R,
    SIGMA_T,
    cameras,
    flat,
    pose_errors,
    truth_of,
    write_scene,
)


@pytest.fixture(scope="module")
def slab(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Result]:
    """A flat plane: nothing holds x, y and the turn about z."""
    scene = write_scene(tmp_path_factory.mktemp("flat") / "scene", surface=flat)
    return scene, depthba.register(scene)


def test_flat_plane_is_not_trusted_and_does_not_drift(slab: tuple[Dataset, Result]) -> None:
    scene, result = slab
    assert result.status == "weak" and not result.trusted
    assert {w.frame for w in result.weak} == {1, 2, 3, 4}
    assert all(w.sigma > 0 and 0 < w.prior_sigma < 0.02 for w in result.weak)
    moved = se3.difference(result.T_world_camera, scene.T_world_camera_measured)
    open_axes = np.abs(moved[:, [0, 1, 5]])
    assert (open_axes < [SIGMA_T, SIGMA_T, SIGMA_R]).all()
    # what the plane does hold is found all the same: height and tilt
    truth = truth_of(scene)
    tilt = se3.difference(result.T_world_camera, truth)[1:, 3:5]
    assert np.abs(tilt).max() < 0.002


def test_flat_plane_names_all_that_is_open(slab: tuple[Dataset, Result]) -> None:
    _, result = slab
    for frame in (1, 2, 3, 4):
        directions = np.array([w.direction for w in result.weak if w.frame == frame])
        assert len(directions) >= 3
        # x, y and the turn about z lie in the span of what is named
        span = np.linalg.qr(directions.T)[0]
        for axis in (0, 1, 5):
            assert np.linalg.norm(span[axis]) > 0.9
    names = " ".join(w.name for w in result.weak)
    assert "x" in names and "y" in names and "turn about z" in names


def test_frame_without_overlap_is_held_and_told(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", shift={3: np.array([5.0, 0.0, 0.0])})
    result = depthba.register(scene)
    assert result.status == "weak" and not result.trusted
    assert "frame 3 was held" in result.reason
    assert "no other frame sees" in result.frames[3].held
    np.testing.assert_allclose(
        result.T_world_camera[3], scene.T_world_camera_measured[3], atol=1e-12
    )
    assert result.frames[3].overlap == 0.0 and not result.overlap[3, [0, 1, 2, 4]].any()
    truth = truth_of(scene)
    others = se3.difference(result.T_world_camera, truth)[[1, 2, 4]]
    assert np.abs(others[:, :3]).mean() < 0.0004 and np.abs(others[:, 3:]).mean() < 0.0008
    # held means as uncertain as measured
    cov = result.covariance[18:24, 18:24]
    np.testing.assert_allclose(np.sqrt(np.diag(cov)), np.repeat([SIGMA_T, SIGMA_R], 3), rtol=1e-6)


def test_frame_without_depth_is_held_and_told(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", empty=[2])
    result = depthba.register(scene)
    assert not result.trusted and "frame 2 was held: 0 points" in result.reason
    np.testing.assert_allclose(
        result.T_world_camera[2], scene.T_world_camera_measured[2], atol=1e-12
    )
    truth = truth_of(scene)
    others = se3.difference(result.T_world_camera, truth)[[1, 3, 4]]
    assert np.abs(others[:, :3]).mean() < 0.0004
    assert np.isfinite(result.covariance).all()


def test_first_frame_without_depth_still_fixes_the_coordinates(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", empty=[0])
    result = depthba.register(scene)
    np.testing.assert_allclose(
        result.T_world_camera[0], scene.T_world_camera_measured[0], atol=1e-12
    )
    # the others are right among each other
    end_t, end_r = pose_errors(result.T_world_camera[1:], truth_of(scene)[1:])
    assert end_t < 0.0005 and end_r < 0.001


@pytest.mark.parametrize(
    ("frames", "empty", "text"),
    [
        (1, [], "1 frame, but registration needs at least 2"),
        (3, [0, 1, 2], "no frame has a single valid depth"),
        (3, [0, 2], "only frame 1 has valid depth"),
    ],
)
def test_dataset_that_cannot_be_registered(
    tmp_path: Path, frames: int, empty: list[int], text: str
) -> None:
    scene = write_scene(tmp_path / "scene", frames=frames, empty=empty)
    with pytest.raises(DatasetError) as caught:
        depthba.register(scene)
    assert text in str(caught.value) and str(tmp_path / "scene") in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_scene(tmp_path_factory.mktemp("options") / "scene", frames=2)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"resolution": 0.0}, "--resolution 0"),
        ({"resolution": -0.01}, "--resolution -0.01"),
        ({"resolution": float("nan")}, "--resolution nan"),
        ({"roi": (0.2, -0.2, -1.0, 1.0, -1.0, 1.0)}, "xmin 0.2 is not below xmax -0.2"),
        ({"roi": (-1.0, 1.0, -1.0, 1.0, 5.0, 6.0)}, "--roi -1 1 -1 1 5 6: no point"),
        ({"preset": "fast"}, "--preset fast: expected one of paper, default"),
        ({"init": "nowhere.txt"}, "--init nowhere.txt"),
        ({"prior_t": 0.0}, "--prior-t 0"),
        ({"prior_r": -1.0}, "--prior-r -1"),
        ({"smoothing": -1.0}, "--smoothing -1"),
        ({"threads": 0}, "--threads 0"),
        ({"max_iterations": 0}, "--max-iterations 0"),
        ({"most_points": 0}, "--most-points 0"),
    ],
)
def test_options_that_make_no_sense(scene: Dataset, options: dict[str, Any], named: str) -> None:
    with pytest.raises(OptionError) as caught:
        depthba.register(scene, Options(**options))
    assert named in str(caught.value) and "\n" not in str(caught.value)


def test_resolution_that_fits_no_memory(scene: Dataset) -> None:
    with pytest.raises(OptionError, match=r"--resolution 1e-06"):
        depthba.register(scene, Options(resolution=1e-6))


def test_init_file_that_lacks_a_frame(scene: Dataset, tmp_path: Path) -> None:
    write_tum(tmp_path / "start.txt", np.array([0.0, 7.0]), cameras(2, np.random.default_rng(0)))
    with pytest.raises(OptionError, match=r"start\.txt: 0 poses for frame 1 at stamp 1\.0"):
        depthba.register(scene, Options(init=str(tmp_path / "start.txt")))


def test_roi_crops(scene: Dataset) -> None:
    whole = depthba.register(scene)
    part = depthba.register(scene, Options(roi=(-0.2, 0.2, -0.2, 0.2, -1.0, 1.0)))
    assert all(0 < p.points < w.points for p, w in zip(part.frames, whole.frames, strict=True))


def test_of_many_points_so_many_are_taken(scene: Dataset) -> None:
    whole, part = depthba.register(scene), depthba.register(scene, Options(most_points=9000))
    assert 4000 < sum(f.points for f in part.frames) <= 9000 + len(scene)
    assert part.trusted and part.depth_map.spacing > 1.2 * whole.depth_map.spacing
    few, all_ = (pose_errors(r.T_world_camera, truth_of(scene)) for r in (part, whole))
    assert few[0] < 4 * all_[0]


def test_folder_that_is_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"dataset\.json"):
        depthba.register(tmp_path)
