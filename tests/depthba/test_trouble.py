"""Scenes that cannot be registered well: the answer is right, or says that it is not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from depthba import se3
from tests.depthba.analytic_scene import Floats, Surface, cameras, flat
from tests.depthba.trouble_scenes import (
    Views,
    assert_honest,
    errors,
    look,
    register,
    truth_of,
    write,
)


def ball(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """A sphere of 3 m: nothing holds a turn about its centre."""
    z = np.sqrt(9.0 - x * x - y * y)
    return z - 3.0, -x / z, -y / z


def pipe(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """A cylinder of 3 m along x: nothing holds a shift along it, or a turn about it."""
    z = np.sqrt(9.0 - y * y)
    return z - 3.0, np.zeros_like(x), -y / z


def groove(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Straight waves along x: nothing holds a shift along them."""
    return 0.05 * np.cos(20 * y), np.zeros_like(x), -np.sin(20 * y)


def moved(views: Views, by: tuple[float, float, float]) -> Views:
    """The same in a world whose origin is elsewhere."""
    T_true, T_measured = views.T_true.copy(), views.T_measured.copy()
    T_true[:, :3, 3] += by
    T_measured[:, :3, 3] += by
    return views.but(T_true=T_true, T_measured=T_measured)


def standing() -> Views:
    """A camera that does not move."""
    return look(T_true=np.repeat(cameras(1, np.random.default_rng(0)), 3, axis=0))


@pytest.mark.parametrize(
    ("views", "scale", "changed"),
    [
        pytest.param(standing, 1.0, {}, id="the same view"),
        pytest.param(
            lambda: moved(look(), (1e6, -1e6, 1e6)), 1.0, {}, id="1000 km from the origin"
        ),
        pytest.param(
            lambda: moved(look(), (1e6, -1e6, 1e6)), 1.0, {"map_frame": "auto"}, id="1000 km, auto"
        ),
        pytest.param(lambda: look().scaled(1e-6), 1e-6, {}, id="micrometres"),
        pytest.param(lambda: look().scaled(1e3), 1e3, {}, id="kilometres"),
        pytest.param(look, 1.0, {"noise": 1e-9}, id="noise stated far too small"),
        pytest.param(look, 1.0, {"noise": 0.0}, id="no noise stated"),
    ],
)
def test_is_right(
    tmp_path: Path, views: Callable[[], Views], scale: float, changed: dict[str, Any]
) -> None:
    scene = write(tmp_path / "scene", views(), scale=scale, **changed)
    result = register(scene)
    assert result.status == "converged", result.reason
    assert_honest(result, scene, scale)
    assert np.abs(errors(result, truth_of(scene), scale)[0]).max() < 0.002


@pytest.mark.parametrize(
    ("surface", "noise", "open_axes"),
    [
        pytest.param(flat, 0.0, (0, 1, 5), id="plane without noise"),
        pytest.param(ball, 0.001, (0, 1, 5), id="sphere"),
        pytest.param(pipe, 0.001, (0, 1), id="cylinder"),
        pytest.param(groove, 0.001, (0,), id="groove"),
    ],
)
def test_what_the_scene_leaves_open_is_named(
    tmp_path: Path, surface: Surface, noise: float, open_axes: tuple[int, ...]
) -> None:
    """Open directions of a turn about a far centre are, near the points, a shift."""
    scene = write(tmp_path / "scene", look(surface, noise=noise))
    result = register(scene)
    assert result.status == "weak" and {w.frame for w in result.weak} == {1, 2}
    for frame in (1, 2):
        span = np.linalg.qr(np.array([w.direction for w in result.weak if w.frame == frame]).T)[0]
        assert all(np.linalg.norm(span[axis]) > 0.8 for axis in open_axes)
    # nor is what is open lost: the poses stay about where they were measured
    moved_by = se3.difference(result.T_world_camera, scene.T_world_camera_measured)
    assert np.abs(moved_by).max() < 0.05


def turned_over(views: Views) -> Views:
    depth = views.depth.copy()
    depth[1] = depth[1, ::-1, ::-1]
    return views.but(depth=depth)


def pose_of_elsewhere(views: Views) -> Views:
    T = views.T_measured.copy()
    T[2] = se3.retract(T[2], [0.1, 0.2, -0.1, 0, 0, 1.57])
    return views.but(T_measured=T)


def strays(views: Views, share: float) -> Views:
    rng = np.random.default_rng(5)
    depth = views.depth.copy()
    stray = rng.random(depth.shape) < share
    depth[stray] = rng.uniform(0.3, 2.5, int(stray.sum()))
    return views.but(depth=depth)


def walls(views: Views) -> Views:
    """Every image one number, a different one: a sensor that measures nothing."""
    flat_images = np.array([1.0, 0.95, 1.02])[:, None, None] * np.ones_like(views.depth)
    return views.but(depth=flat_images)


def pixels(views: Views, count: int) -> Views:
    depth = np.full_like(views.depth, np.nan)
    depth[:, 30, 20 : 20 + count] = views.depth[:, 30, 20 : 20 + count]
    return views.but(depth=depth)


def far_apart() -> Views:
    T = cameras(2, np.random.default_rng(0))
    T[1, 0, 3] += 8.0
    return look(T_true=T)


def in_millimetres(views: Views) -> Views:
    T = views.T_measured.copy()
    T[:, :3, 3] *= 1000
    return views.but(T_measured=T)


def times(views: Views, factor: float) -> Views:
    return views.but(depth=factor * views.depth)


@pytest.mark.parametrize(
    ("views", "changed", "said"),
    [
        # seeds at which the wrong frame finds a place where it settles
        pytest.param(
            lambda: turned_over(look(frames=4, seed=5)), {}, "frame 1 lies", id="upside down"
        ),
        pytest.param(
            lambda: pose_of_elsewhere(look(frames=4, seed=3)),
            {},
            "frame 2 does not fit",
            id="turned by 90 degrees",
        ),
        pytest.param(lambda: strays(look(frames=2), 0.5), {}, "", id="50 % strays"),
        pytest.param(lambda: strays(look(), 0.99), {}, "", id="99 % strays"),
        pytest.param(lambda: look(noise=0.1), {}, "", id="noise x 100"),
        pytest.param(lambda: look(noise=0.1), {"noise": 0.1}, "", id="noise x 100, stated"),
        pytest.param(lambda: walls(look()), {}, "", id="constant depth"),
        pytest.param(lambda: pixels(look(), 1), {}, "1 points, fewer", id="one pixel"),
        pytest.param(far_apart, {}, "no other frame sees", id="no overlap"),
        pytest.param(
            lambda: in_millimetres(look(frames=2)), {}, "no other", id="poses in millimetres"
        ),
        pytest.param(
            lambda: times(look(), 1e3), {"depth_scale": 0.05}, "", id="depth in millimetres"
        ),
        pytest.param(
            lambda: times(look(), 1e-3), {"depth_scale": 5e-8}, "no other", id="depth in kilometres"
        ),
    ],
)
def test_what_cannot_be_right_is_not_trusted(
    tmp_path: Path, views: Callable[[], Views], changed: dict[str, Any], said: str
) -> None:
    scene = write(tmp_path / "scene", views(), **changed)
    result = register(scene)
    assert_honest(result, scene)
    assert not result.trusted and said in result.reason, result.reason


def test_without_belief_in_poses_a_frame_that_does_not_fit_is_named(tmp_path: Path) -> None:
    scene = write(tmp_path / "scene", pose_of_elsewhere(look(frames=4, seed=3)))
    result = register(scene, priors=False)
    assert_honest(result, scene)
    assert not result.trusted


def test_a_frame_that_repeats_another_is_left_out(tmp_path: Path) -> None:
    views = look(frames=4)
    depth = views.depth.copy()
    depth[2] = depth[0]
    scene = write(tmp_path / "scene", views.but(depth=depth))
    result = register(scene)
    assert result.status == "weak"
    assert "frame 2 was held: its points are those of frame 0 to the last digit" in result.reason
    np.testing.assert_allclose(result.T_world_camera[2], views.T_measured[2], atol=1e-9)
    # and does not draw the others along
    assert np.abs(errors(result, views.T_true)[0][[1, 3]]).max() < 0.002
