"""Quadric patches: their normal equations, what groups of points say, recovery of steep scenes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from depthba import se3
from depthba.optimiser import tying
from depthba.optimiser.laying import Cloud, lay
from depthba.optimiser.patches import Patches
from depthba.optimiser.prior import move
from depthba.optimiser.tying import FAR, patches_beside
from depthba.optimiser.workers import Workers
from tests.depthba.balls import N, balls, poses
from tests.depthba.optimiser_problems import problem_of


@pytest.fixture(scope="module")
def workers():
    made = Workers(2)
    yield made
    made.close()


@pytest.fixture(scope="module")
def laid(workers):
    rng = np.random.default_rng(3)
    T = poses(rng)
    fit = lay(balls(rng, T, 3e-4, flat=1.5), T, (0.06, 0.03), 10.0, 3e-4, workers)
    return T, fit.patches


def settled(patches: Patches, T, workers, rounds=60):
    return patches.fitted(T, workers, rounds)


@pytest.mark.parametrize("rays", [True, False])
def test_the_gradient_is_that_of_the_cost_with_the_surfaces_settled(laid, workers, rays):
    T, patches = laid
    # where surfaces are settled, what they cost changes with the poses alone
    patches = replace(patches, rays=rays, scale=1.0)
    rng = np.random.default_rng(5)
    T = move(T, T[:, :3, 3], 1e-4 * rng.normal(size=(N, 6)))
    pivots = T[:, :3, 3] + rng.normal(0, 0.2, (N, 3))
    there = settled(patches, T, workers).patches
    _, g = there.normal_equations(T, pivots, workers)
    found, step = np.empty((N, 6)), 1e-6
    for i, k in np.ndindex(N, 6):
        d = np.zeros((N, 6))
        d[i, k] = step
        costs = [settled(there, move(T, pivots, s * d), workers).cost for s in (1, -1)]
        found[i, k] = (costs[0] - costs[1]) / (2 * step)
    # 2 g is the derivative of a sum of squares, but for how weights change with the normal
    scale = np.abs(2 * g).max()
    np.testing.assert_allclose(2 * g, found, atol=1e-2 * scale)


def test_the_matrix_is_the_second_derivative_where_residuals_are_small(workers):
    rng = np.random.default_rng(1)
    T = poses(rng)
    patches = lay(balls(rng, T, 1e-6), T, (0.03,), 10.0, 1e-6, workers).patches
    patches = replace(patches, rays=False, scale=1.0)
    there = settled(patches, T, workers)
    A, g = there.patches.normal_equations(T, T[:, :3, 3], workers)
    d = 2e-4 * rng.normal(size=(N, 6))
    after = settled(there.patches, move(T, T[:, :3, 3], d), workers).cost
    expected = there.cost + 2 * float((g * d).sum()) + float(d.ravel() @ A @ d.ravel())
    assert after == pytest.approx(expected, rel=0.05)


def test_all_frames_moved_as_one_cost_the_same(laid, workers):
    T, patches = laid
    A, _ = patches.normal_equations(T, np.zeros((N, 3)), workers)
    # surfaces follow a shift along, and to first order a turn of, the whole scene
    as_one = np.tile(np.eye(6), (N, 1))
    shared = np.abs(as_one.T @ A @ as_one)
    own = sum(np.abs(A[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]) for i in range(N))
    assert (shared[:2, :2] < 0.2 * own[:2, :2].max()).all()
    assert np.linalg.eigvalsh(A)[0] > -1e-9 * np.linalg.eigvalsh(A)[-1]


def test_patches_that_count_three_times_say_so_three_times(laid, workers):
    T, patches = laid
    fit = settled(patches, T, workers)
    more = fit.counted(3.0)
    assert more.patches.fitted(T, workers).cost == pytest.approx(3 * fit.cost, rel=1e-6)
    assert more.cost == pytest.approx(3 * fit.cost)
    for once, thrice in zip(
        fit.patches.normal_equations(T, T[:, :3, 3], workers),
        more.patches.normal_equations(T, T[:, :3, 3], workers),
        strict=True,
    ):
        np.testing.assert_allclose(thrice, 3 * once, atol=1e-6 * np.abs(once).max())


def test_groups_of_points_add_up_to_the_gradient(laid, workers):
    T, patches = laid
    T = move(T, T[:, :3, 3], 1e-4 * np.ones((N, 6)))
    pivots = T[:, :3, 3]
    there = settled(patches, T, workers).patches
    _, g = there.normal_equations(T, pivots, workers)
    rng = np.random.default_rng(2)
    groups = [rng.integers(0, 5, (2, 2500)).astype(np.uint8) for _ in range(N)]
    scores = there.scores(T, pivots, groups, 5, workers)
    assert scores.shape == (2, 5, 6 * N)
    # what is left of the surfaces' own gradient, and their stiffness, are not the points'
    np.testing.assert_allclose(
        scores.sum(axis=1), np.tile(g.ravel(), (2, 1)), atol=1e-3 * np.abs(g).max()
    )


def test_one_and_two_threads_say_the_same(laid, workers):
    T, patches = laid
    alone = Workers(1)
    for one, two in zip(
        patches.normal_equations(T, T[:, :3, 3], alone),
        patches.normal_equations(T, T[:, :3, 3], workers),
        strict=True,
    ):
        np.testing.assert_array_equal(one, two)


def test_balls_on_nothing_bring_the_frames_together(workers):
    rng = np.random.default_rng(11)
    T_true = poses(rng)
    cloud = balls(rng, T_true, 3e-4)
    T = move(T_true, T_true[:, :3, 3], 4e-3 * rng.normal(size=(N, 6)) * (np.arange(N) > 0)[:, None])
    began = np.abs(T - T_true).max()
    for _ in range(6):
        fit = lay(replace(cloud, rays=False), T, (0.03,), FAR.robust, 3e-4, workers)
        for _ in range(4):
            pivots = np.zeros((N, 3))
            A, g = fit.patches.normal_equations(T, pivots, workers)
            step = np.zeros(6 * N)
            step[6:] = -np.linalg.solve(A[6:, 6:], g.ravel()[6:])
            T = move(T, pivots, step.reshape(N, 6))
            fit = fit.patches.fitted(T, workers)
    assert began > 5e-3
    assert np.abs(T[:, :3] - T_true[:, :3]).max() < 2e-4


def test_of_very_many_points_some_are_taken_and_known_by_their_place(workers, monkeypatch):
    rng = np.random.default_rng(4)
    T = poses(rng)
    cloud = balls(rng, T, 1e-4, points=4000)
    clouds = [
        np.column_stack([cloud.points[cloud.frame == i], np.ones((4000, 2))]) for i in range(N)
    ]
    problem = problem_of(clouds, T, 0.004)
    whole = patches_beside(problem, T, 0.02, 0.02, 3.5, 3e-4, workers, 1.0)
    monkeypatch.setattr(tying, "MOST_BESIDE", 6000)
    some = patches_beside(problem, T, 0.02, 0.02, 3.5, 3e-4, workers, 1.0)
    assert whole is not None and some is not None
    assert 500 < len(some.patches.points) < 6000 < len(whole.patches.points)
    for fit in (whole, some):
        frame = np.repeat(fit.patches.frame, np.diff(fit.patches.ends))
        for i in range(N):
            mine, source = fit.patches.points[frame == i], fit.patches.source[frame == i]
            assert len(set(source)) == len(source)
            np.testing.assert_array_equal(mine, problem.frames[i].points[source])


def test_a_voxel_that_one_frame_sees_is_no_patch(workers):
    rng = np.random.default_rng(0)
    T = poses(rng)
    cloud = balls(rng, T, 1e-4)
    alone = cloud.frame == 1
    one = cloud.weighed(alone.astype(float), Workers(1))
    fit = lay(one, T, (0.06, 0.03), 3.5, 1e-4, workers)
    assert len(fit.patches) == 0
    assert fit.cost == 0.0
    A, g = fit.patches.normal_equations(T, T[:, :3, 3], workers)
    assert not A.any()
    assert not g.any()


@pytest.mark.parametrize("sided", [True, False])
def test_the_two_sides_of_a_thin_wall_are_two_surfaces(workers, sided):
    rng, half = np.random.default_rng(1), 0.002
    left, right = se3.make(np.eye(3), [-0.5, 0.0, 0.2]), se3.make(np.eye(3), [0.5, 0.0, 0.2])
    T = np.stack([left, left, right, right])
    T[1::2, 1, 3] = 0.1
    frame = np.repeat(np.arange(4, dtype=np.int32), 2000)
    wall = rng.uniform([0, -0.15, 0], [0, 0.15, 0.2], (len(frame), 3))
    wall[:, 0] = np.where(frame < 2, -half, half) + 1e-4 * rng.normal(size=len(frame))
    cloud = Cloud(
        (wall - T[frame, :3, 3]).astype(np.float32), np.ones(len(frame)), frame,
        np.tile(np.arange(2000, dtype=np.int32), 4), False, sided,
    )  # fmt: skip
    # voxels that hold both sides
    off = np.eye(4)
    off[:3, 3] = 0.015
    fit = lay(cloud, off @ T, (0.03,), 3.5, 1e-4, workers)
    seen = [set(fit.patches.frame[a:b] // 2) for a, b in pairwise(fit.patches.views)]
    if sided:
        assert seen.count({0}) > 20 and seen.count({1}) > 20 and {0, 1} not in seen
        assert fit.patches.deviation < 1.5e-4
        # and all points of a patch are its own: each in one patch, by view
        x = fit.patches.points + T[np.repeat(fit.patches.frame, np.diff(fit.patches.ends)), :3, 3]
        side = np.repeat(fit.patches.frame // 2, np.diff(fit.patches.ends))
        np.testing.assert_allclose(x[:, 0], np.where(side == 0, -half, half), atol=6e-4)
    else:
        assert seen.count({0, 1}) > 20 and fit.patches.deviation > 1e-3
