"""Leaving out the points where the map bends too sharply to be trusted to a thousandth.

At a step a camera sees the side that faces it and not the other; the map blurs the step, and every
frame is drawn a little to its own side of it. That is a bias and not noise: all steps pull a frame
the same way, no comparison of residuals shows it, and it is small beside what registration has to
find, but not beside what a robot gets wrong.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from depthba.optimiser.level import Level

Array = NDArray[np.float64]

# Change of slope from one cell to the next. Measured on lab scenes: where more is kept the depths
# contradict the truth, where less is kept they leave the robot's own errors undecided.
SHARP = 2.0


def without_bends(level: Level, heights: Array, T_map_camera: Array) -> Level:
    """Return the level with no points at nodes, or next to some, where the map bends sharply.

    Args:
        level: the points and the grid.
        heights: (ny, nx), the map.
        T_map_camera: (N, 4, 4).
    """
    grid = level.grid
    bend = np.zeros(grid.shape)
    bend[1:-1] = np.abs(heights[2:] - 2 * heights[1:-1] + heights[:-2])
    across = np.abs(heights[:, 2:] - 2 * heights[:, 1:-1] + heights[:, :-2])
    bend[:, 1:-1] = np.maximum(bend[:, 1:-1], across)
    sharp = binary_dilation(bend > SHARP * grid.spacing, np.ones((3, 3), bool))
    frames = []
    for frame, T in zip(level.problem.frames, T_map_camera, strict=True):
        xy = frame.points[:, :3] @ T[:2, :3].T + T[:2, 3]
        k = np.rint((xy - grid.origin) / grid.spacing).astype(int)
        x, y = np.clip(k, 0, [grid.shape[1] - 1, grid.shape[0] - 1]).T
        points = frame.points.copy()
        points[sharp[y, x], 4] = 0.0
        frames.append(replace(frame, points=points))
    return replace(level, problem=replace(level.problem, frames=tuple(frames)))
