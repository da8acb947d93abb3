"""The methods on planes, on a small dataset: from the start to poses, and what they refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from depthba import se3
from depthba.dataset import Dataset
from depthba.errors import OptionError
from eval.methods.balm2.attempts import register_best
from eval.methods.balm2.schedule import Schedule
from eval.methods.method import MethodError, Stopwatch, Task
from eval.methods.planes import Balm2, Balm2CoarseToFine, frame_extent, halvings

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def task(dataset: Dataset) -> Task:
    return Task.of(dataset)


def off(T: Floats, dataset: Dataset) -> Floats:
    """Mean absolute errors relative to frame 0, m and rad."""
    assert dataset.T_world_camera_true is not None
    e = np.abs(se3.difference(se3.align_first(T, dataset.T_world_camera_true),
                              dataset.T_world_camera_true))[1:]  # fmt: skip
    return np.array([e[:, :3].mean(), e[:, 3:].mean()])


@pytest.mark.parametrize(
    "method, share",
    # voxels of one size take in only starts much nearer than the dataset's
    [(Balm2(voxel=0.1), 0.2), (Balm2CoarseToFine(), 1.0)],
    ids=["fixed", "fine"],
)
def test_poses_get_better_and_frame_0_stays(
    method: Balm2 | Balm2CoarseToFine, share: float, task: Task, dataset: Dataset
) -> None:
    T_true = dataset.T_world_camera_true
    start = se3.retract(T_true, share * se3.difference(task.T_world_camera, T_true))
    kept = start.copy()
    estimate = method.run(replace(task, T_world_camera=start))
    np.testing.assert_array_equal(start, kept)
    np.testing.assert_allclose(estimate.T_world_camera[0], start[0], atol=1e-12)
    assert se3.is_rigid(estimate.T_world_camera)
    assert set(estimate.seconds) == {"thin", "planes", "solve"}
    assert estimate.iterations and estimate.iterations > 0 and not estimate.notes
    assert np.all(off(estimate.T_world_camera, dataset) < 0.8 * off(start, dataset))
    assert off(estimate.T_world_camera, dataset)[0] < 0.0006


def test_the_result_moves_with_the_world(task: Task) -> None:
    moved = se3.retract(np.eye(4), np.array([3.0, -2.0, 1.0, 0.4, -1.0, 2.0]))
    here = Balm2().run(task).T_world_camera
    there = Balm2().run(replace(task, T_world_camera=moved @ task.T_world_camera)).T_world_camera
    np.testing.assert_allclose(there, moved @ here, atol=1e-9)


def test_a_frame_without_points_stays_and_is_named(task: Task) -> None:
    clouds = list(task.clouds)
    clouds[3] = clouds[3][:0]
    lonely = replace(task, clouds=tuple(clouds))
    for method in (Balm2(), Balm2CoarseToFine()):
        estimate = method.run(lonely)
        assert estimate.notes == ("frames that see too few planes to move: 3",)
        np.testing.assert_allclose(estimate.T_world_camera[3], task.T_world_camera[3], atol=1e-12)


def test_nothing_to_register_is_a_method_error(task: Task) -> None:
    empty = replace(task, clouds=tuple(c[:0] for c in task.clouds))
    far = np.tile(np.eye(4), (len(task), 1, 1))
    far[:, 0, 3] = 100.0 * np.arange(len(task))
    for method in (Balm2(), Balm2CoarseToFine()):
        with pytest.raises(MethodError, match="no frame has points"):
            method.run(empty)
        with pytest.raises(MethodError, match="no frame sees 6 planes"):
            method.run(replace(task, T_world_camera=far))


def test_of_several_schedules_the_one_that_fits_counts(task: Task, dataset: Dataset) -> None:
    good = Schedule((0.25, 0.125), task.spacing, rounds=8, reach=0.25)
    # never leaves the start
    bad = replace(good, reach=1e-9)
    for schedules in ([bad, good], [good, bad]):
        found = register_best(task.clouds, task.T_world_camera, schedules, 0.125, 1.1, Stopwatch())
        better = off(found.T_world_camera, dataset)
        assert np.all(better < off(task.T_world_camera, dataset) / 3)


def test_sizes_of_voxels_follow_the_scene(task: Task) -> None:
    # 80 x 60 pixels, each 1 m / 80 wide
    assert frame_extent(task) == pytest.approx(np.sqrt(4800) / 80, rel=0.02)
    np.testing.assert_allclose(halvings(0.16, 0.02), [0.16, 0.08, 0.04, 0.02])
    assert halvings(0.16, 0.021) == (0.16, 0.08, 0.04)
    assert halvings(0.1, 0.2) == (0.1,)
    with pytest.raises(OptionError, match=r"voxels from 0\.1 to 0 m"):
        halvings(0.1, 0)
