"""How coarse points are made for methods that fit planes to a few of them."""

from __future__ import annotations

import numpy as np

from eval.methods.method import Task

COARSEST = 4.0
"""In point spacings."""
NOISE = 6.0
"""In standard deviations of the range."""


def usual_voxel(task: Task) -> float:
    """Return the edge of the cubes that points are averaged in, m.

    A plane through the 20 nearest points leans at random where the noise of the range is a good
    part of their distances. So points are six standard deviations of the range apart, as the
    sensor is stated to have it at the median depth, but no finer than they were measured, and no
    more than four spacings, which would lose shape; that many where no noise is stated.
    """
    coarsest = COARSEST * task.spacing
    noise = task.dataset.sensor.noise
    depths = [np.median(points[:, 2]) for points in task.clouds if len(points)]
    if noise is None or not depths:
        return coarsest
    sigma = float(noise.sigma(float(np.median(depths))))
    return float(np.clip(NOISE * sigma, task.spacing, coarsest))
