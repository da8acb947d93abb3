"""What patches say of a camera's fixed pattern: derivatives, and what groups of points say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from depthba.camera import Camera
from depthba.dataset.sensor import Sensor
from depthba.optimiser import patch_waves
from depthba.optimiser.laying import lay
from depthba.optimiser.prior import move
from depthba.optimiser.waves import waves_of
from depthba.optimiser.workers import Workers
from tests.depthba.balls import N, balls, poses

CAMERA = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)
WAVES = waves_of(Sensor("depth", "", CAMERA, 1e-4, None, None, None, True), 1e-3)


@pytest.fixture(scope="module")
def workers():
    made = Workers(2)
    yield made
    made.close()


def fitted(patches, T, workers):
    return patches.fitted(T, workers, 60)


def bent(patches, pattern):
    """The points with a pattern (m,) taken off along their rays."""
    error = WAVES.at(patches.points) @ pattern
    way = np.linalg.norm(patches.points, axis=1)
    return replace(patches, points=patches.points * (1 - error / way)[:, None])


@pytest.fixture(scope="module")
def laid(workers):
    """Poses a little off, and patches laid there whose surfaces have settled."""
    rng = np.random.default_rng(3)
    T = poses(rng)
    fit = lay(balls(rng, T, 3e-4, flat=1.5), T, (0.06, 0.03), 10.0, 3e-4, workers)
    T = move(T, T[:, :3, 3], 1e-4 * rng.normal(size=(N, 6)))
    return T, fitted(replace(fit.patches, scale=1.0), T, workers).patches


def test_the_gradient_is_that_of_the_cost_with_the_surfaces_settled(laid, workers):
    T, patches = laid
    told = patch_waves.told(patches, T, T[:, :3, 3], WAVES, workers)
    step = 1e-5 * np.eye(len(WAVES))
    costs = [[fitted(bent(patches, s * d), T, workers).cost for s in (1, -1)] for d in step]
    found = -np.diff(costs, axis=1)[:, 0] / 2e-5
    assert np.abs(told.gradient).max() > 0
    np.testing.assert_allclose(2 * told.gradient, found, atol=0.02 * np.abs(found).max())


def test_the_matrix_is_the_second_derivative_of_pattern_and_poses(workers):
    rng = np.random.default_rng(1)
    T = poses(rng)
    patches = lay(balls(rng, T, 1e-6, flat=1.5), T, (0.03,), 10.0, 1e-6, workers).patches
    there = fitted(replace(patches, scale=1.0), T, workers)
    pivots = T[:, :3, 3]
    A, g = there.patches.normal_equations(T, pivots, workers)
    told = patch_waves.told(there.patches, T, pivots, WAVES, workers)
    for turn, bend in ((2e-4, 0.0), (0.0, 2e-4), (1e-4, 1e-4), (1e-4, -2e-4)):
        d, a = turn * rng.normal(size=6 * N), bend * rng.normal(size=len(WAVES))
        moved = move(T, pivots, d.reshape(N, 6))
        after = fitted(bent(there.patches, a), moved, workers).cost
        linear = 2 * float(g.ravel() @ d + told.gradient @ a)
        square = float(d @ A @ d + 2 * d @ told.cross @ a + a @ told.own @ a)
        assert after == pytest.approx(there.cost + linear + square, rel=0.005)


def test_surfaces_move_with_the_pattern_as_stated(laid, workers):
    T, patches = laid
    told = patch_waves.told(patches, T, T[:, :3, 3], WAVES, workers)
    a = 2e-5 * np.random.default_rng(7).normal(size=len(WAVES))
    moved = fitted(bent(patches, a), T, workers).patches.surface - patches.surface
    # heights above the middles of the patches; taking a pattern off moves points towards the camera
    expected = -told.surfaces[:, 0] @ a
    assert np.corrcoef(moved[:, 0], expected)[0, 1] > 0.99
    assert np.linalg.norm(moved[:, 0] - expected) < 0.1 * np.linalg.norm(expected)


def test_groups_of_points_add_up_to_the_gradient(laid, workers):
    T, patches = laid
    told = patch_waves.told(patches, T, T[:, :3, 3], WAVES, workers)
    rng = np.random.default_rng(2)
    groups = [rng.integers(0, 5, (2, 2500)).astype(np.uint8) for _ in range(N)]
    found = patch_waves.scores(patches, T, WAVES, told.surfaces, groups, 5, workers)
    assert found.shape == (2, 5, len(WAVES))
    # what is left of the surfaces' own gradient, and their stiffness, are not the points'
    scale = np.abs(told.gradient).max()
    np.testing.assert_allclose(found.sum(axis=1), np.tile(told.gradient, (2, 1)), atol=1e-3 * scale)


def test_points_of_more_than_one_run_say_the_same(laid, workers, monkeypatch):
    T, patches = laid
    whole = patch_waves.told(patches, T, T[:, :3, 3], WAVES, workers)
    monkeypatch.setattr(patch_waves, "AT_ONCE", len(patches.points) // 7)
    parts = patch_waves.told(patches, T, T[:, :3, 3], WAVES, workers)
    for one, other in ((whole.own, parts.own), (whole.cross, parts.cross)):
        np.testing.assert_allclose(other, one, atol=1e-12 * np.abs(one).max())
    np.testing.assert_array_equal(whole.surfaces, parts.surfaces)


def test_one_and_two_threads_say_the_same(laid, workers):
    T, patches = laid
    alone = patch_waves.told(patches, T, T[:, :3, 3], WAVES, Workers(1))
    both = patch_waves.told(patches, T, T[:, :3, 3], WAVES, workers)
    np.testing.assert_array_equal(alone.own, both.own)
    np.testing.assert_array_equal(alone.gradient, both.gradient)
