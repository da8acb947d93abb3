"""Points that lie close together, and what they tell beside one another."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from depthba.optimiser import crowding
from depthba.optimiser.feet import Ground
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import Linearisation, Loss, State
from depthba.optimiser.problem import Problem
from depthba.optimiser.solver import solve_map
from depthba.optimiser.workers import Workers
from tests.depthba.optimiser_problems import Floats, flat_case, problem_of

SPACING = 0.02
GRID = Grid(np.array([-0.44, -0.44]), SPACING, (45, 45))
LOSS = Loss(True, True, 0.0, 2 * SPACING, 0.0, 1e-3)


@dataclass(frozen=True)
class Case:
    """Points of a plane, their map at the true poses, and the linearisation there."""

    problem: Problem
    state: State
    lin: Linearisation

    @staticmethod
    def of(sparse: int = 1, noise: float = 0.001) -> Case:
        """Return a case of which every second frame has fewer points."""
        T, clouds = flat_case(40000, noise, noise, frames=6)
        problem = problem_of(clouds, T, spacing=0.003)
        frames = tuple(f.thinned(sparse if i % 2 else 1) for i, f in enumerate(problem.frames))
        problem = replace(problem, frames=frames)
        state, smooth = State(T, np.zeros(GRID.shape)), np.ones(GRID.shape, bool)
        return Case(problem, *solve_map(problem, GRID, state, LOSS, smooth, Workers(1), 2, 1e-8))

    def places(self) -> list[tuple[NDArray[np.int32], Floats]]:
        """Return place and points in it of each frame's."""
        ground = Ground(self.problem, GRID, self.state, LOSS)
        side = crowding.SIDE * self.problem.spacing
        frames = range(len(self.problem.frames))
        return [crowding.places(ground.feet(i).arms, side) for i in frames]

    def with_errors(self, rho: float, sparse: float = 1.0) -> Case:
        """Return the case with residuals that are correlated by rho within places.

        ``sparse`` times as large in every second frame. Some points are off the map.
        """
        rng, residuals = np.random.default_rng(1), []
        for i, (place, count) in enumerate(self.places()):
            shared, own = rng.standard_normal(len(count))[place], rng.standard_normal(len(place))
            e = 0.003 * (np.sqrt(rho) * shared + np.sqrt(1 - rho) * own)
            e[::7] = np.nan
            residuals.append((e * (sparse if i % 2 else 1.0)).astype(np.float32))
        weights = tuple(np.ones_like(e) for e in residuals)
        lin = replace(self.lin, residuals=tuple(residuals), weights=weights)
        return replace(self, lin=lin)

    def told(self, threads: int = 2) -> Problem:
        """Return the problem with its points counting as far as they tell."""
        workers = Workers(threads)
        told = crowding.told(self.problem, GRID, self.state, LOSS, self.lin, workers)
        return told.applied(self.problem, workers)


def test_places_are_voxels() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
    points[-1] = -1e9  # far off: it may share a place, but nothing breaks
    place, count = crowding.places(points.T, 0.3)
    voxel = np.floor(points[:-1] / 0.3).astype(int)
    _, same, sizes = np.unique(voxel, axis=0, return_inverse=True, return_counts=True)
    assert np.unique(np.stack([same.ravel(), place[:-1]]), axis=1).shape[1] == len(sizes)
    assert count.sum() == len(points)
    assert (count[place[:-1]] - sizes[same.ravel()] <= 1).all()


def test_no_points_are_no_places() -> None:
    place, count = crowding.places(np.zeros((3, 0)), 0.1)
    assert len(place) == 0 and not count.any()


@pytest.fixture
def believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let effects of any size be believed in full."""
    monkeypatch.setattr(crowding, "SLIGHT", 1.1)
    monkeypatch.setattr(crowding, "MOST", 100.0)


@pytest.mark.usefixtures("believed")
@pytest.mark.parametrize("rho", [0.1, 0.4])
def test_places_tell_what_their_mean_does(rho: float) -> None:
    case = Case.of().with_errors(rho)
    less = case.told()
    for (place, count), frame in zip(case.places(), less.frames, strict=True):
        usual = (count >= 13) & (count <= 19)  # sizes of which there are fewer go by these
        n, told = count[usual], np.bincount(place, frame.share, len(count))[usual]
        # of the points of a place six in seven are on the map
        assert told == pytest.approx(n / (1 + (6 / 7 * n - 1) * rho), rel=0.12)


@pytest.mark.usefixtures("believed")
def test_places_that_err_more_tell_less() -> None:
    less = Case.of(sparse=8).with_errors(0.0, sparse=3.0).told()
    # sparse points have 3^2 times the variance, and there are eight times fewer of them
    typical = (8 + 3**2) / (8 + 1)
    dense, sparse = (np.median(f.share) for f in less.frames[:2])
    assert dense == 1.0 and sparse == pytest.approx(typical / 3**2, rel=0.2)


def test_no_point_tells_less_than_is_believed() -> None:
    less = Case.of().with_errors(0.9).told()
    assert min(f.share.min() for f in less.frames) == pytest.approx(1 / crowding.MOST)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("noise", [0.001, 0.003])
def test_independent_noise_leaves_all_points_whole(noise: float, threads: int) -> None:
    # noise as large as a place: sorted by where they were measured, points would lie with their
    # like
    case = Case.of(noise=noise)
    assert case.told(threads) is case.problem


def test_nothing_on_the_map_tells_nothing() -> None:
    case = Case.of()
    lin = replace(
        case.lin, residuals=tuple(np.full(len(f), np.nan, np.float32) for f in case.problem.frames)
    )
    assert replace(case, lin=lin).told() is case.problem
