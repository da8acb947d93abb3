"""Frames one at a time, cancelling and time limits: the real thing on a small scene."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

import depthba
from depthba.dataset import Dataset
from depthba.errors import Cancelled, DatasetError, OptionError
from depthba.options import Options
from tests.depthba.analytic_scene import pose_errors, truth_of, write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_scene(tmp_path_factory.mktemp("live") / "scene", frames=6)


def registration(scene: Dataset, **options: object) -> depthba.Registration:
    return depthba.Registration(
        scene.sensor,
        Options(**options),  # type: ignore[arg-type]
        map_frame=scene.map_frame,
        pose_noise=scene.pose_noise,
    )


def test_frames_one_at_a_time_end_where_all_at_once_do(scene: Dataset) -> None:
    truth = truth_of(scene)
    with registration(scene) as live:
        for k, frame in enumerate(scene):
            update = live.add(frame)
            assert update.frame == frame.id and update.T_world_camera.shape == (k + 1, 4, 4)
            assert len(live) == k + 1 and (k == 0) == bool(update.held)
            if k > 1:
                placed = pose_errors(update.T_world_camera, truth[: k + 1])
                assert placed[0] < 0.002 and placed[1] < 0.003
        result = live.result()
        with pytest.raises(DatasetError, match="frame 3 was added before"):
            live.add(next(f for f in scene if f.id == 3))
    end, whole = pose_errors(result.T_world_camera, truth), depthba.register(scene)
    assert result.trusted and end[0] < 0.0003 and end[1] < 0.0006
    assert result.frame_ids == whole.frame_ids and result.covariance.shape == (36, 36)
    apart = pose_errors(result.T_world_camera, whole.T_world_camera)
    deviation = np.sqrt(np.diag(whole.covariance)[6:]).reshape(-1, 6)
    assert apart[0] < deviation[:, :3].mean() and apart[1] < deviation[:, 3:].mean()


def test_frame_without_ground_in_common_is_held(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", frames=4, shift={2: np.array([5.0, 0.0, 0.0])})
    with registration(scene) as live:
        held = [live.add(frame).held for frame in scene]
    assert "no other frame sees" in held[2] and not held[3]


def test_too_few_frames(scene: Dataset) -> None:
    with registration(scene) as live:
        live.add(scene[0])
        with pytest.raises(DatasetError, match="needs 2 or more frames"):
            live.result()


def test_cancel_ends_soon_and_leaves_no_thread(scene: Dataset) -> None:
    stop = threading.Event()
    before = threading.active_count()
    depthba.register(scene)

    def count(_: depthba.Iteration) -> None:
        stop.set()

    with pytest.raises(Cancelled, match="cancelled"):
        depthba.register(scene, callback=count, cancel=stop.is_set)
    deadline = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() <= before


def test_time_limit_returns_what_was_reached(scene: Dataset) -> None:
    result = depthba.register(scene, Options(time_limit=1e-6))
    assert result.status == "not_converged" and "time limit of 1e-06 s" in result.reason
    assert len(result.history) <= 2 and np.isfinite(result.covariance).all()
    with pytest.raises(OptionError, match="--time-limit -1"):
        depthba.register(scene, Options(time_limit=-1.0))
