"""Cells that one height cannot describe: walls, edges, one thing above another.

Their points count for less.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import map_kernels
from depthba.optimiser.asking import look
from depthba.optimiser.grid import Grid, average, filled, make_grid
from depthba.optimiser.problem import FramePoints, Problem
from depthba.optimiser.workers import SHARES, Workers

# Scatter within a cell is measured on cells this many times the spacing of the points: fewer points
# say nothing.
COARSEST = 3.0
# Scatter up to this many times the typical one passes for noise.
USUAL = 4.0


def down_weighted(
    problem: Problem, T_map_camera: NDArray[np.float64], spacing: float, workers: Workers
) -> Problem:
    """Return the problem with the points of rough cells taken for as noisy as they are.

    Fixed for the level.

    What one frame's points scatter about the averaged map within a cell is noise plus relief that
    the map cannot hold. Up to a few times the typical scatter it is taken for noise; beyond, the
    point's noise grows with it. The weight hangs on the point, not on the cell: one that changes
    cell keeps it, so nothing is gained by moving.
    """
    rough, grid = roughness(problem, T_map_camera, spacing, workers)
    if not rough.any():
        return problem
    factor = 1.0 / np.maximum(1.0, rough)

    def lessened(frame: FramePoints, T: NDArray[np.float64]) -> FramePoints:
        a = _look_up(factor, frame.points, T, grid).astype(np.float32)
        # what a rough cell scatters is not noise but bias: it gets less than the weight of its
        # variance
        return replace(frame, inverse_noise=frame.inverse_noise * a, share=frame.share * a**2)

    return replace(problem, frames=tuple(workers.map(lessened, problem.frames, T_map_camera)))


def rough_points(
    problem: Problem, T_map_camera: NDArray[np.float64], spacing: float, workers: Workers
) -> list[NDArray[np.bool_]]:
    """Say of each frame, (n,), which of its points lie in cells that one height cannot describe."""
    rough, grid = roughness(problem, T_map_camera, spacing, workers)

    def of(frame: FramePoints, T: NDArray[np.float64]) -> NDArray[np.bool_]:
        return _look_up(rough, frame.points, T, grid) > 1.0

    return workers.map(of, problem.frames, T_map_camera)


def roughness(
    problem: Problem, T_map_camera: NDArray[np.float64], spacing: float, workers: Workers
) -> tuple[NDArray[np.float64], Grid]:
    """Return (ny, nx) the scatter within cells over what passes for noise, and the cells."""
    grid = make_grid(problem, max(spacing, COARSEST * problem.spacing), 2 * spacing)
    rough = scatter(problem, T_map_camera, grid, workers)
    typical = float(np.median(rough[rough > 0])) if (rough > 0).any() else 0.0
    return rough / (USUAL * typical) if typical else np.zeros(grid.shape), grid


def scatter(
    problem: Problem, T_map_camera: NDArray[np.float64], grid: Grid, workers: Workers
) -> NDArray[np.float64]:
    """Return (ny, nx) the standard deviation within a frame of heights about the averaged map.

    Pooled over frames.
    """
    nodes = np.empty((*grid.shape, 3))
    heights = filled(average(problem, T_map_camera, grid).heights)
    map_kernels.nodal_rows(heights, grid.spacing, nodes, 0, len(heights))
    squares, freedom = np.zeros(grid.shape), np.zeros(grid.shape)

    def within(i: int) -> NDArray[np.float64]:
        look()
        T, found = T_map_camera[i], np.zeros((*grid.shape, 3))
        map_kernels.splat_residuals(
            problem.frames[i].points, T[:3, :3].copy(), T[:3, 3].copy(), grid.origin, grid.spacing,
            nodes, found,
        )  # fmt: skip
        return found

    # a grid for each frame would take more memory than its points
    frames = range(len(problem.frames))
    for some in (frames[k : k + SHARES] for k in frames[::SHARES]):
        for found in workers.map(within, some):
            map_kernels.pool_scatter(found, squares, freedom)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0) / np.maximum(freedom, 1.0)))


def _look_up(
    field: NDArray[np.float64], points: NDArray[np.float32], T: NDArray[np.float64], grid: Grid
) -> NDArray[np.float64]:
    """Return the field's value at the node nearest to each point; 1 off the grid."""
    look()
    out = np.empty(len(points))
    map_kernels.look_up(
        points, T[:3, :3].copy(), T[:3, 3].copy(), grid.origin, grid.spacing, field, out
    )
    return out
