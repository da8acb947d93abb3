"""What the residuals say of the noise of the points."""

from __future__ import annotations

import numpy as np
import pytest

from depthba.optimiser.deviation import robust_deviation
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import Linearisation, Loss, State
from depthba.optimiser.noise import by_range, noise_sigma
from depthba.optimiser.problem import Problem
from depthba.optimiser.solver import solve_map
from depthba.optimiser.workers import Workers
from tests.depthba.optimiser_problems import Floats, flat_case, problem_of

SPACING = 0.02
GRID = Grid(np.array([-0.44, -0.44]), SPACING, (45, 45))
LOSS = Loss(False, True, 0.0, 2 * SPACING, 0.0, 1e-3)


def solved(problem: Problem, T: Floats) -> tuple[State, Linearisation]:
    """Return the map for the poses, which are the true ones."""
    state, smooth = State(T, np.zeros(GRID.shape)), np.ones(GRID.shape, bool)
    return solve_map(problem, GRID, state, LOSS, smooth, Workers(1), 2, 1e-8)


@pytest.mark.parametrize("per_node", [2, 6, 30])
def test_noise_is_told_although_the_map_follows_the_points(per_node: int) -> None:
    T, clouds = flat_case(int(per_node / 2 * (0.6 / SPACING) ** 2))
    problem = problem_of(clouds, T)
    sigma = noise_sigma(problem, GRID, *_of(problem, T))
    assert sigma == pytest.approx(0.001, rel=0.1)


@pytest.mark.parametrize("per_node", [20, 80])
@pytest.mark.parametrize(("near", "far"), [(0.001, 0.001), (0.002, 0.001), (0.001, 0.0015)])
def test_noise_that_differs_over_the_range_is_found(near: float, far: float, per_node: int) -> None:
    T, clouds = flat_case(int(per_node / 4 * (0.6 / SPACING) ** 2), near, far, frames=4)
    problem = problem_of(clouds, T)
    shown = by_range(problem, GRID, *_of(problem, T))
    close, away = np.interp([0.6, 1.0], shown.ranges, shown.factors)
    assert close / away == pytest.approx(near / far, rel=0.12)
    # with that taken into account nothing is left to find
    weighed = shown.applied(problem, Workers(1))
    again = by_range(weighed, GRID, *_of(weighed, T))
    assert again.wrong < 1.12
    assert shown.wrong > 1.2 or near == far


def test_noise_is_as_stated_where_the_range_says_nothing() -> None:
    T, clouds = flat_case(100)
    problem = problem_of(clouds, T)
    shown = by_range(problem, GRID, *_of(problem, T))
    assert shown.wrong == 1.0 and shown.applied(problem, Workers(1)) is problem


def _of(problem: Problem, T: Floats) -> tuple[State, Loss, Linearisation]:
    state, lin = solved(problem, T)
    return state, LOSS, lin


@pytest.mark.parametrize("count", [1, 2, 7, 1000])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_robust_deviation_is_what_the_median_says(count: int, dtype: type) -> None:
    values = np.random.default_rng(count).normal(size=count).astype(dtype)
    before = values.copy()
    assert robust_deviation(values) == float(1.4826 * np.median(np.abs(values)))
    assert (values == before).all()
