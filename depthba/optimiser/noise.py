"""The noise of the points, as their residuals show it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import probes
from depthba.optimiser.deviation import robust_deviation
from depthba.optimiser.feet import Ground
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import Linearisation, Loss, State, robust_sigma
from depthba.optimiser.problem import FramePoints, Problem
from depthba.optimiser.workers import Workers

Array = NDArray[np.float64]

# Points of a frame that its noise is measured on.
SAMPLE = 5000
# Leverage above which a residual says nothing about its point's noise.
FOLLOWED = 0.7
# Parts of the range that noise is measured in, of as many points each; fewer points say nothing.
PARTS, FEWEST = 12, 500
# How far the noise of a part may lie from the typical one.
LEAST, MOST = 0.7, 2.5
# Ranges that differ by less are one.
SAME = 1.02


@dataclass(frozen=True)
class Studentised:
    """Residuals of some points of a frame, each by what its leverage leaves of its noise."""

    sizes: Array
    """(n,), m."""
    ranges: Array
    """(n,), m."""
    whole: NDArray[np.bool_]
    """(n,), whether all of the point's cost counts."""


def noise_sigma(
    problem: Problem, grid: Grid, state: State, loss: Loss, lin: Linearisation
) -> float:
    """Return the robust standard deviation of the points' noise, m."""
    each = np.concatenate([s.sizes for s in studentised(problem, grid, state, loss, lin)])
    return robust_deviation(each) if len(each) else robust_sigma(lin.residuals)


def studentised(
    problem: Problem, grid: Grid, state: State, loss: Loss, lin: Linearisation
) -> list[Studentised]:
    """Return the size of the residuals of some points of each frame.

    A map with few points on a node follows them, so that their residuals are smaller than their
    noise: each is divided by the root of what its leverage leaves (the externally known part of a
    studentised residual, Cook & Weisberg 1982).
    """
    ground = Ground(problem, grid, state, loss)
    found = []
    for i, frame in enumerate(problem.frames):
        stride = max(1, len(frame) // SAMPLE)
        some, feet = frame.thinned(stride), ground.feet(i, stride)
        pull = np.empty(len(some))
        probes.leverages(
            some.inverse_noise, some.share, feet.on, feet.cells, feet.fractions, feet.norm2,
            lin.weights[i][::stride], lin.C.own, pull,
        )  # fmt: skip
        free = pull < FOLLOWED
        sizes = np.abs(lin.residuals[i][::stride][free]) / np.sqrt(1.0 - pull[free])
        found.append(Studentised(sizes, _ranges(some.points[free]), some.share[free] >= 1.0))
    return found


@dataclass(frozen=True)
class ByRange:
    """By how much noise differs from the stated one, over the distance from the sensor."""

    ranges: Array
    """(k,), m, ascending."""
    factors: Array
    """(k,), 1 at a typical point."""

    @classmethod
    def as_stated(cls) -> ByRange:
        """Return no difference."""
        return cls(np.empty(0), np.empty(0))

    @property
    def wrong(self) -> float:
        """The largest factor, or inverse of one."""
        return float(np.exp(np.abs(np.log(self.factors)).max())) if len(self.factors) else 1.0

    def applied(self, problem: Problem, workers: Workers) -> Problem:
        """Return the problem with its points taken for as noisy as that."""
        if not len(self.factors):
            return problem
        return replace(problem, frames=tuple(workers.map(self._of, problem.frames)))

    def _of(self, frame: FramePoints) -> FramePoints:
        factor = np.interp(_ranges(frame.points), self.ranges, self.factors).astype(np.float32)
        return replace(frame, inverse_noise=frame.inverse_noise / factor)


def by_range(problem: Problem, grid: Grid, state: State, loss: Loss, lin: Linearisation) -> ByRange:
    """Return how the noise over the range differs from the stated one (variance function).

    Points of cells that one height cannot describe do not take part: they are known to be off
    (Davidian & Carroll 1987).
    """
    seen = studentised(problem, grid, state, loss, lin)
    sizes = np.concatenate([s.sizes[s.whole] for s in seen])
    away = np.concatenate([s.ranges[s.whole] for s in seen])
    if not problem.origin or len(sizes) < 2 * FEWEST:
        return ByRange.as_stated()
    order = np.argsort(away, kind="stable")
    parts = np.array_split(order, min(PARTS, len(order) // FEWEST))
    ranges = np.array([np.median(away[p]) for p in parts])
    if ranges[-1] < SAME * ranges[0]:
        return ByRange.as_stated()
    deviations = np.array([robust_deviation(sizes[p]) for p in parts])
    typical = float(np.median(deviations))
    if not typical:
        return ByRange.as_stated()
    return ByRange(ranges, np.clip(deviations / typical, LEAST, MOST))


def _ranges(points: NDArray[np.float32]) -> Array:
    return np.asarray(np.linalg.norm(points.astype(float), axis=1))
