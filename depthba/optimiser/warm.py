"""Compile the kernels ahead of use, into the disk cache: ``python -m depthba.optimiser.warm``."""

from __future__ import annotations

import numpy as np

from depthba.optimiser import certainty, eliminate
from depthba.optimiser.grid import Grid
from depthba.optimiser.layers import down_weighted
from depthba.optimiser.linearise import Loss, State, linearise
from depthba.optimiser.prior import pose_prior
from depthba.optimiser.problem import FramePoints, Problem
from depthba.optimiser.workers import Workers


def warm() -> None:
    """Register two tiny frames by hand, touching every kernel once."""
    rng = np.random.default_rng(0)
    T = np.repeat(np.diag([1.0, -1.0, -1.0, 1.0])[None], 2, axis=0)
    T[:, 2, 3] = 1.0
    xy = rng.uniform(-0.4, 0.4, (400, 2))
    z = 1.0 + 0.1 * np.sin(5 * xy).sum(axis=1)
    points, ones = np.column_stack([xy, z]).astype(np.float32), np.ones(400, np.float32)
    blocks = rng.integers(0, 48, 400).astype(np.uint8)
    hull = points.astype(float)
    frame = FramePoints(points, ones, ones, blocks, np.array([0.0, 0.0, 1.0]), hull, 0.3)
    bounds = np.array([-0.4, -0.4])
    problem = Problem((frame, frame), T, np.eye(4), bounds, -bounds, True, 0.04, 0.001)
    workers = Workers(1)
    problem = down_weighted(problem, T, 0.1, workers)
    grid = Grid(np.array([-1.0, -1.0]), 0.1, (21, 21))
    state = State(T, np.zeros(grid.shape))
    loss = Loss(True, True, 0.01, 0.2, 1e-4, 1e-4)
    lin = linearise(problem, grid, state, loss, workers, np.ones(grid.shape, bool))
    free = np.array([False, True])
    prior = pose_prior(T, np.eye(3), np.ones(3), np.ones(3), ~free)
    certainty.correlation(problem, grid, state, loss, lin, prior, free, workers)
    eliminate.solve(lin, free, prior.at(T).normal_equations(lin.pivots), 0.0, workers, 1e-2, 12)


if __name__ == "__main__":
    warm()
