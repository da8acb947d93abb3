"""One level of the schedule: its grid, and everything that stays fixed on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import schedule
from depthba.optimiser.grid import Averages, Grid, average, filled, make_grid, near, resample
from depthba.optimiser.layers import down_weighted
from depthba.optimiser.linearise import Loss
from depthba.optimiser.patches import Fit
from depthba.optimiser.problem import Problem
from depthba.optimiser.workers import Workers
from depthba.options import Options


@dataclass(frozen=True)
class Level:
    """One grid of the schedule, with everything that stays fixed on it."""

    problem: Problem
    grid: Grid
    averages: Averages
    smooth: NDArray[np.bool_]
    loss: Loss
    tied: Fit | None = None
    """Patches that tie the frames where a map cannot; None: there are none."""


def make_level(
    problem: Problem,
    poses: NDArray[np.float64],
    spacing: float,
    preset: schedule.Preset,
    options: Options,
    workers: Workers,
    last: bool = True,
) -> Level:
    """Lay the grid of a level and fix what stays fixed on it. The last one takes every point."""
    if not last:
        problem = problem.thinned(schedule.stride(problem, spacing))
    grid = make_grid(problem, spacing, 2 * spacing)
    averages = average(problem, poses, grid)
    if preset.robust:
        problem = down_weighted(problem, poses, spacing, workers)
    seen = averages.count > 0
    smooth = np.ones(grid.shape, bool) if preset.whole else near(seen, 3)
    typical = float(np.median(averages.count[seen])) if seen.any() else 1.0
    return Level(
        problem,
        grid,
        averages,
        smooth,
        schedule.loss_for(preset, options, problem, spacing, typical),
    )


def level_heights(
    level: Level, heights: NDArray[np.float64] | None, previous: Grid | None
) -> NDArray[np.float64]:
    """Return the heights that a level starts from: the coarser map, or averages on the first."""
    if heights is None or previous is None:
        return filled(level.averages.heights)
    return resample(heights, previous, level.grid)
