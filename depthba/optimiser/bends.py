"""Leaving out the points where the map bends too sharply to be trusted to a thousandth.

At a step a camera sees the side that faces it and not the other; the map blurs the step, and every
frame is drawn a little to its own side of it. That is a bias and not noise: all steps pull a frame
the same way, and no comparison of residuals shows it. Steps help to find the poses; they cannot
vouch for them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from depthba.optimiser.asking import look
from depthba.optimiser.grid import Grid
from depthba.optimiser.problem import Problem

Array = NDArray[np.float64]

# Change of slope from one cell to the next.
SHARP = 1.0


def without_bends(
    problem: Problem, grid: Grid, heights: Array, T_map_camera: Array, sharp_from: float = SHARP
) -> Problem:
    """Return the problem with no points at nodes, or next to some, where the map bends sharply.

    Args:
        problem: the points.
        grid: where the nodes stand.
        heights: (ny, nx), the map.
        T_map_camera: (N, 4, 4).
        sharp_from: change of slope from one cell to the next.
    """
    bend = np.zeros(grid.shape)
    bend[1:-1] = np.abs(heights[2:] - 2 * heights[1:-1] + heights[:-2])
    across = np.abs(heights[:, 2:] - 2 * heights[:, 1:-1] + heights[:, :-2])
    bend[:, 1:-1] = np.maximum(bend[:, 1:-1], across)
    sharp = binary_dilation(bend > sharp_from * grid.spacing, np.ones((3, 3), bool))
    frames = []
    for frame, T in zip(problem.frames, T_map_camera, strict=True):
        look()
        xy = frame.points @ T[:2, :3].T + T[:2, 3]
        k = np.rint((xy - grid.origin) / grid.spacing).astype(int)
        x, y = np.clip(k, 0, [grid.shape[1] - 1, grid.shape[0] - 1]).T
        frames.append(replace(frame, share=np.where(sharp[y, x], np.float32(0.0), frame.share)))
    return replace(problem, frames=tuple(frames))
