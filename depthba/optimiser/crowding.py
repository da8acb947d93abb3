"""Points that lie close together in one frame err alike: they tell less than as many apart.

What a stereo camera matches, what a map cannot hold and what light does to a surface is much the
same from one pixel to the next. The sum of n independent residuals varies n times as much as one;
that of n in one place by more, which is their *design effect* (Kish 1965), and each of them tells
less by that. Without it near and level surfaces, which have many points, outvote far and steep
ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import crowding_kernels
from depthba.optimiser.asking import look
from depthba.optimiser.feet import Ground
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import Linearisation, Loss, State
from depthba.optimiser.problem import FramePoints, Problem
from depthba.optimiser.workers import Workers

Array = NDArray[np.float64]

# Side of a place, in spacings of the points.
SIDE = 4.0
# Design effect below which, in places of any size, points are taken for independent.
SLIGHT = 2.0
# Larger ones are not believed in full: chosen by trial, see docs/optimiser.md.
MOST = 1.5
# Places are told apart by powers of two of how many points they have, up to so many. Fewer places
# of a size say too little of their own.
CLASSES, FEWEST = 16, 1000
# Points that are asked for it, of whole frames.
ENOUGH = 500_000


@dataclass(frozen=True)
class Told:
    """What points tell beside the others of their place."""

    shares: tuple[NDArray[np.float32], ...] = ()
    """(n,) of each frame, of what they would tell alone; empty: all of it."""

    def applied(self, problem: Problem, workers: Workers) -> Problem:
        """Return the problem with its points counting so much."""
        if not self.shares:
            return problem

        def counting(frame: FramePoints, share: NDArray[np.float32]) -> FramePoints:
            return replace(frame, share=frame.share * share)

        return replace(problem, frames=tuple(workers.map(counting, problem.frames, self.shares)))


def told(
    problem: Problem, grid: Grid, state: State, loss: Loss, lin: Linearisation, workers: Workers
) -> Told:
    """Return what points tell beside those close to them, as their residuals show it.

    Args:
        problem: the points.
        grid: where the nodes stand.
        state: the solution.
        loss: how the residual is taken.
        lin: the linearisation there.
        workers: the threads.
    """
    ground = Ground(problem, grid, state, loss)

    def sorted_into(i: int) -> tuple[NDArray[np.int32], Array]:
        return places(ground.feet(i).arms, SIDE * problem.spacing)

    def scatter(i: int) -> Array:
        place, count = sorted_into(i)
        out = np.zeros((CLASSES, 5))
        crowding_kernels.scatter(place, lin.residuals[i] * lin.weights[i], count, out)
        return out

    def shares(i: int) -> NDArray[np.float32]:
        place, count = sorted_into(i)
        believed = np.minimum(np.interp(np.log2(count[place]), sizes, effects), MOST)
        return (1.0 / believed).astype(np.float32)

    frames = range(len(problem.frames))
    stride = max(1, sum(map(len, problem.frames)) // ENOUGH)
    sizes, effects = design_effects(np.sum(workers.map(scatter, frames[::stride]), axis=0))
    return Told(tuple(workers.map(shares, frames)) if effects.max() > SLIGHT else ())


def design_effects(scatter: Array) -> tuple[Array, Array]:
    """Return how much more the residuals of a place sum up to, by how many points it has.

    As far as the loss lets them count, in units of what as many typical ones would.

    Args:
        scatter: (CLASSES, 5), see :func:`crowding_kernels.scatter`.

    Returns:
        (k,), logarithms to base 2 of numbers of points, ascending, and (k,) factors, at least 1.
    """
    number, n, size, together, alone = scatter.T
    used = number >= FEWEST
    if not used.any() or not alone.any():
        return np.zeros(1), np.ones(1)
    effects = together[used] / n[used] / (alone.sum() / n.sum())
    return size[used] / n[used], np.maximum(effects, 1.0)


def places(points: Array, side: float) -> tuple[NDArray[np.int32], Array]:
    """Return the place of each point, a voxel of the given side, m, and each one's points.

    Args:
        points: (3, n), m. Where they meet the map: noise would sort them by its own sign.
        side: m.

    Returns:
        (n,), and (m,), of which some are 0.
    """
    look()
    n = points.shape[1]
    bits = int(np.ceil(np.log2(2 * n + 2)))
    place, count = np.empty(n, np.int32), np.zeros(1 << bits)
    crowding_kernels.sort(points, side, bits, place, count)
    return place, count
