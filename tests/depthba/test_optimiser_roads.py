"""Both roads to a step, their parts, and that threads change nothing."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg

from depthba.optimiser import eliminate, map_solver, reduced
from depthba.optimiser.bends import without_bends
from depthba.optimiser.certainty import beyond_scalar
from depthba.optimiser.eliminate import Step
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import Linearisation, linearise
from depthba.optimiser.map_solver import MapSolver
from depthba.optimiser.mixing import Mixer
from depthba.optimiser.stencil import Stencil
from depthba.optimiser.workers import Workers
from tests.depthba.optimiser_problems import (
    ROBUST,
    awkward_case,
    flat_case,
    problem_of,
)


@pytest.fixture(scope="module")
def lin() -> Linearisation:
    case = awkward_case(0)
    return linearise(case.problem, case.grid, case.state, ROBUST, Workers(1), case.smooth)


def mass_like(shape: tuple[int, int], seed: int = 0) -> Stencil:
    """A positive definite stencil with the couplings of scattered points."""
    rng = np.random.default_rng(seed)
    C = Stencil(rng.uniform(2.0, 9.0, shape), *(rng.uniform(0.0, 0.2, shape) for _ in range(4)))
    C.right[:, -1] = C.up[-1] = C.up_right[-1] = C.up_left[-1] = 0.0
    C.up_right[:, -1] = C.up_left[:, -1] = 0.0
    return C


@pytest.mark.parametrize("tolerance", [1e-3, 1e-10])
def test_map_solver_is_the_same_on_any_number_of_threads(
    tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    C = mass_like((301, 47))
    b = np.random.default_rng(1).standard_normal((301, 47))
    one_group, _ = MapSolver(C, tolerance).solve(b, tolerance)
    monkeypatch.setattr(map_solver, "FEW", 1)
    found = []
    for threads in (1, 2, 3):
        workers = Workers(threads)
        found.append(MapSolver(C, tolerance, workers).solve(b, tolerance)[0])
        workers.close()
        np.testing.assert_array_equal(found[-1], found[0])
    for x in (one_group, found[0]):
        left = (b - C.times(x)) / np.sqrt(C.own)
        assert np.linalg.norm(left) < 1.5 * tolerance * np.linalg.norm(b / np.sqrt(C.own))


@pytest.mark.parametrize("few", [10**9, 1])
@pytest.mark.parametrize("shape", [(1, 9), (2, 5), (17, 1), (31, 8), (33, 20), (130, 6)])
def test_map_solver_on_strips_of_any_shape(
    shape: tuple[int, int], few: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Strips of the least height, strips cut short, strips without a row."""
    monkeypatch.setattr(map_solver, "FEW", few)
    whole = mass_like((shape[0] + 2, shape[1] + 2))
    # the couplings of a window point outside it: all other nodes are held at zero
    C = whole.window(slice(1, shape[0] + 1), slice(1, shape[1] + 1))
    b = np.random.default_rng(2).standard_normal(shape)
    got, iterations = MapSolver(C, 1e-10, Workers(1)).solve(b, 1e-10)
    inner = np.zeros((shape[0] + 2, shape[1] + 2), bool)
    inner[1:-1, 1:-1] = True
    dense = whole.sparse().toarray()[np.ix_(inner.ravel(), inner.ravel())]
    np.testing.assert_allclose(got.ravel(), np.linalg.solve(dense, b.ravel()), atol=1e-9)
    assert iterations < 20


def scattered(shape: tuple[int, int], seed: int = 3) -> Stencil:
    """The stencil of three points a cell, each a bilinear mean of four heights."""
    rng, cells = np.random.default_rng(seed), (shape[0] - 1) * (shape[1] - 1)
    y, x = rng.uniform(0, 1, (2, 3 * cells)) * (np.array([shape]).T - 1)
    i, j = y.astype(int), x.astype(int)
    v, u = y - i, x - j
    low, right, up, far = (1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u
    C = Stencil(np.full(shape, 1e-2), *(np.zeros(shape) for _ in range(4)))
    for field, pairs in (
        (C.own, ((low, low, 0, 0), (right, right, 0, 1), (up, up, 1, 0), (far, far, 1, 1))),
        (C.right, ((low, right, 0, 0), (up, far, 1, 0))),
        (C.up, ((low, up, 0, 0), (right, far, 0, 1))),
        (C.up_right, ((low, far, 0, 0),)),
        (C.up_left, ((right, up, 0, 0),)),
    ):
        for one, other, dy, dx in pairs:
            np.add.at(field, (i + dy, j + dx), one * other)
    return C


def test_sweeps_take_less_than_half_the_iterations_of_scaling_alone() -> None:
    C, count = scattered((96, 80)), 0
    b = np.random.default_rng(4).standard_normal((96, 80))
    _, swept = MapSolver(C, 1e-8).solve(b, 1e-8)

    def counted(_: object) -> None:
        nonlocal count
        count += 1

    scaling = sp.diags(1 / C.own.ravel())
    scipy.sparse.linalg.cg(C.sparse(), b.ravel(), rtol=1e-8, M=scaling, callback=counted)
    assert 0 < swept < 0.5 * count


def test_loose_tolerance_leaves_an_error_of_second_order(lin: Linearisation) -> None:
    want = reduced.exact_sparse(lin)
    scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
    coarse, fine = (
        np.abs((reduced.reduce(lin, Workers(1), t).S - want) / scale).max() for t in (1e-2, 1e-4)
    )
    assert coarse < 1e-2 and fine < 1e-5


def test_frames_that_stand_still_are_left_out(lin: Linearisation) -> None:
    free = np.array([False, True, True, False])
    whole, part = (reduced.reduce(lin, Workers(1), 1e-8, f).S for f in (None, free))
    keep = np.ix_(np.repeat(free, 6), np.repeat(free, 6))
    np.testing.assert_allclose(part[keep], whole[keep], rtol=1e-12)


def test_both_roads_lead_to_the_same_step(lin: Linearisation) -> None:
    """The iterative road, preconditioned by a matrix of another place, against the direct one."""
    n, workers = len(lin.A), Workers(1)
    free = np.arange(n) > 0
    nothing = np.eye(6 * n), np.zeros((n, 6))
    here = reduced.reduce(lin, workers, 1e-8)
    elsewhere = reduced.reduce(lin, workers, 1e-2).S + 0.1 * np.diag(np.diag(here.S))
    direct = eliminate.solve(lin, free, nothing, 0.0, workers, 1e-9, 0, here=here)
    iterative = eliminate.solve(lin, free, nothing, 0.0, workers, 1e-9, 200, near=elsewhere)
    for one, other in ((direct.pose, iterative.pose), (direct.map, iterative.map)):
        assert np.linalg.norm(one - other) < 1e-6 * np.linalg.norm(one)
    assert iterative.decrement == pytest.approx(direct.decrement, rel=1e-5)


def test_step_without_noise_in_it_is_the_plain_one(lin: Linearisation) -> None:
    n, workers = len(lin.A), Workers(1)
    free = np.arange(n) > 0
    prior = np.eye(6 * n), np.full((n, 6), 0.1)
    here = reduced.reduce(lin, workers, 1e-8)
    plain = eliminate.solve(lin, free, prior, 0.0, workers, 1e-9, 0, here=here)
    all_of_it, nothing = (eliminate.Held.of(here.S, S0, free) for S0 in (here.S, 0 * here.S))
    sure = eliminate.solve(lin, free, prior, 0.0, workers, 1e-9, 0, held=all_of_it)
    np.testing.assert_allclose(sure.pose, plain.pose, atol=1e-5 * np.abs(plain.pose).max())
    # where all is noise, the measured poses alone decide
    held = eliminate.solve(lin, free, prior, 0.0, workers, 1e-9, 0, held=nothing)
    np.testing.assert_allclose(held.pose[1:], -0.1, rtol=1e-6)


def test_mixing_ends_a_linear_process_early() -> None:
    """Steps of a linear iteration with rates 0.2 to 0.8: plain, the error would shrink by 0.8."""
    rng = np.random.default_rng(0)
    rates, goal = np.linspace(0.2, 0.8, 12), rng.standard_normal(12)
    x, mixer = np.zeros(12), Mixer()
    for _ in range(12):
        step = Step(((1 - rates) * (goal - x)).reshape(2, 6), np.zeros((1, 1)), 0.0)
        mixed = mixer.mix(step, np.eye(12))
        mixer.took(mixed)
        x = x + mixed.pose.ravel()
    assert np.linalg.norm(x - goal) < 0.1 * 0.8**12 * np.linalg.norm(goal)


def test_points_at_a_step_are_left_out_and_no_others() -> None:
    T, clouds = flat_case(4000)
    problem, grid = problem_of(clouds, T), Grid(np.array([-0.44, -0.44]), 0.02, (45, 45))
    x = grid.origin[0] + grid.spacing * np.arange(45)
    heights = np.tile(np.where(x > 0.05, 0.1, 0.3 * x), (45, 1))
    kept = without_bends(problem, grid, heights, T)
    for frame, pose in zip(kept.frames, T, strict=True):
        at = frame.points @ pose[0, :3] + pose[0, 3]
        share = frame.share
        assert not share[np.abs(at - 0.05) < 0.02].any()
        assert (share[np.abs(at - 0.05) > 0.06] == 1.0).all()


def test_only_what_adds_up_over_blocks_widens_the_covariance() -> None:
    """Independent scores add nothing; a pattern in one direction adds what it is, there alone."""
    rng = np.random.default_rng(5)
    d, blocks = 30, 48
    root = np.tril(rng.standard_normal((d, d))) + 3 * np.eye(d)
    S = root @ root.T
    scores = rng.standard_normal((blocks, d)) @ root.T / np.sqrt(blocks)
    assert not beyond_scalar(scores, S, 1.0).size
    u = root @ np.eye(d)[3]
    pattern = scores + 40 * rng.standard_normal((blocks, 1)) * u / np.sqrt(blocks)
    found = np.linalg.solve(root, beyond_scalar(pattern, S, 1.0))
    white = found @ found.T
    values, vectors = np.linalg.eigh(white)
    assert 800 < values[-1] < 2600 and np.abs(values[:-1]).max() < 1e-6 * values[-1]
    assert abs(vectors[3, -1]) > 0.99
