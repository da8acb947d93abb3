"""The map's stencil and its elimination against dense linear algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from depthba.optimiser import eliminate, reduced
from depthba.optimiser.linearise import Linearisation, Workers, linearise
from depthba.optimiser.map_solver import MapSolver
from tests.depthba.optimiser_problems import (
    LOSSES,
    RANGE,
    Floats,
    awkward_case,
    dense_of,
    stencil_dense,
)


def linearised(name: str, seed: int = 0, threads: int = 1) -> Linearisation:
    case, workers = awkward_case(seed), Workers(threads)
    lin = linearise(case.problem, case.grid, case.state, LOSSES[name], workers, case.smooth)
    workers.close()
    return lin


@pytest.fixture(scope="module", params=["vertical", "robust"])
def lin(request: pytest.FixtureRequest) -> Linearisation:
    return linearised(request.param)


def schur(lin: Linearisation) -> Floats:
    """A - B C^-1 B^T, dense."""
    H, n = dense_of(lin)[0], 6 * len(lin.A)
    return np.asarray(H[:n, :n] - H[:n, n:] @ np.linalg.solve(H[n:, n:], H[n:, :n]))


def test_stencil_is_the_dense_matrix(lin: Linearisation) -> None:
    C, v = stencil_dense(lin), np.random.default_rng(0).standard_normal(lin.g_map.shape)
    scale = np.abs(C).max()
    np.testing.assert_allclose(lin.C.times(v).ravel(), C @ v.ravel(), atol=1e-12 * scale)
    np.testing.assert_allclose(lin.C.sparse().toarray(), C, atol=1e-12 * scale)
    np.testing.assert_allclose(lin.C.row_sums().ravel(), np.abs(C).sum(axis=1), rtol=1e-12)


def test_stencil_solves(lin: Linearisation) -> None:
    C, b = stencil_dense(lin), np.random.default_rng(1).standard_normal(lin.g_map.shape)
    solver = MapSolver(lin.C, 1e-12)
    got, iterations = solver.solve(b, 1e-12, 5000)
    assert 0 < iterations < 5000
    want = np.linalg.solve(C, b.ravel())
    np.testing.assert_allclose(got.ravel(), want, atol=1e-8 * np.abs(want).max())
    assert solver.solve(np.zeros_like(b), 1e-12) == (pytest.approx(np.zeros_like(b)), 0)


def test_exact_agrees_with_dense(lin: Linearisation) -> None:
    want = schur(lin)
    atol = 1e-8 * np.abs(want).max()
    np.testing.assert_allclose(reduced.exact_sparse(lin), want, atol=atol)
    np.testing.assert_allclose(reduced.exact(lin, Workers(1), 1e-12), want, atol=atol)
    np.testing.assert_allclose(reduced.exact(lin, Workers(1)), want, atol=atol)


def test_lumped_bounds_exact_from_above(lin: Linearisation) -> None:
    S, bound = schur(lin), reduced.lumped(lin, Workers(1))
    np.testing.assert_allclose(bound, bound.T, atol=1e-12 * np.abs(bound).max())
    assert np.linalg.eigvalsh(bound - S).min() >= -1e-10 * np.abs(S).max()
    # and S itself has no negative direction, which the damping relies upon
    assert np.linalg.eigvalsh(S).min() >= -1e-10 * np.abs(S).max()
    # frames of the same ground: their blocks are coupled, so the bound says more than A alone
    assert np.abs(bound[:6, 6:12]).max() > 0.01 * np.abs(bound).max()


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_step_agrees_with_dense(lin: Linearisation, damping: float) -> None:
    """Damping scales the diagonal of the lumped matrix of the poses, priors included."""
    n, rng = len(lin.A), np.random.default_rng(3)
    free = np.array([False, *[True] * (n - 1)])
    root = rng.standard_normal((6 * n, 6 * n))
    prior = root @ root.T, rng.standard_normal((n, 6))
    workers = Workers(1)
    step = eliminate.solve(lin, free, prior, damping, workers, 1e-10, 200)
    H, g = dense_of(lin)
    bound = reduced.lumped(lin, workers)
    H[: 6 * n, : 6 * n] += prior[0]
    bound += prior[0]
    g[: 6 * n] += prior[1].ravel()
    undamped = H.copy()
    H[range(6 * n), range(6 * n)] += damping * np.diag(bound)
    keep = np.concatenate([np.repeat(free, 6), np.ones(lin.g_map.size, bool)])
    want = np.zeros(len(g))
    want[keep] = -np.linalg.solve(H[np.ix_(keep, keep)], g[keep])
    assert not step.pose[0].any()
    got = np.concatenate([step.pose.ravel(), step.map.ravel()])
    assert np.linalg.norm(got - want) <= 1e-6 * np.linalg.norm(want)
    k = 6 * n
    np.testing.assert_allclose(step.pose.ravel(), want[:k], atol=1e-6 * np.abs(want[:k]).max())
    S = undamped[:k, :k] - undamped[:k, k:] @ np.linalg.solve(undamped[k:, k:], undamped[k:, :k])
    assert step.decrement == pytest.approx(want[:k] @ S @ want[:k], rel=1e-5)


def test_lumped_step_descends_less_far_but_downhill(lin: Linearisation) -> None:
    """Without the correction the step is the bound's own: short where S is weak, never uphill."""
    n = len(lin.A)
    free = np.array([False, *[True] * (n - 1)])
    nothing = np.zeros((6 * n, 6 * n)), np.zeros((n, 6))
    workers = Workers(1)
    H, g = dense_of(lin)

    def gain(tolerance: float, outer: int) -> float:
        step = eliminate.solve(lin, free, nothing, 0.0, workers, tolerance, outer)
        x = np.concatenate([step.pose.ravel(), step.map.ravel()])
        return float(-(g @ x + x @ H @ x / 2))

    lumped, corrected = gain(1e-8, 0), gain(1e-8, 200)
    assert 0 < lumped <= corrected * (1 + 1e-9)


def test_frame_that_nothing_holds_does_not_break_the_step() -> None:
    case = awkward_case(1)
    far = case.state.T_map_camera.copy()
    far[2, :3, 3] += [50.0, 0.0, 0.0]
    state = replace(case.state, T_map_camera=far)
    lin = linearise(case.problem, case.grid, state, RANGE, Workers(1), case.smooth)
    assert not lin.A[2].any()
    nothing = np.zeros((24, 24)), np.zeros((4, 6))
    free = np.array([False, True, True, True])
    step = eliminate.solve(lin, free, nothing, 0.0, Workers(1), 1e-2, 12)
    assert np.isfinite(step.pose).all() and np.isfinite(step.map).all()
    assert not step.pose[2].any()


def test_threads_change_the_last_digits_at_most() -> None:
    one, two, again = (
        linearised("robust"),
        linearised("robust", threads=2),
        linearised("robust", threads=2),
    )
    H1, H2, H3 = (dense_of(lin)[0] for lin in (one, two, again))
    np.testing.assert_array_equal(H2, H3)
    np.testing.assert_allclose(H1, H2, atol=1e-12 * np.abs(H1).max())
