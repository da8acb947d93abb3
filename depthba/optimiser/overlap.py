"""Which frames see the same ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import map_kernels
from depthba.optimiser.asking import look
from depthba.optimiser.grid import make_grid
from depthba.optimiser.problem import Problem

# Of a frame's cells, the share that others must see too; below it the frame is held where it was
# measured.
LEAST = 0.05
# Points below which a frame says nothing.
FEWEST = 50


def overlap_matrix(
    problem: Problem, T_map_camera: NDArray[np.float64], spacing: float
) -> NDArray[np.float64]:
    """Return (N, N), the share of frame i's cells that frame j sees too.

    0 for a frame without points.
    """
    grid = make_grid(problem, max(spacing, 4 * problem.spacing), 0.0)
    seen = np.zeros((len(problem.frames), grid.shape[0] * grid.shape[1]), np.float32)
    for i, (frame, T) in enumerate(zip(problem.frames, T_map_camera, strict=True)):
        look()
        n = np.zeros(grid.shape)
        unused = np.zeros(grid.shape)
        map_kernels.splat(
            frame.points, T[:3, :3].copy(), T[:3, 3].copy(), grid.origin, grid.spacing, unused, n
        )
        seen[i] = (n > 0).ravel()
    cells = seen.sum(axis=1)
    look()
    return np.asarray((seen @ seen.T) / np.maximum(cells, 1)[:, None], dtype=float)


def held_frames(problem: Problem, overlap: NDArray[np.float64]) -> list[str]:
    """Return, per frame, why it cannot move; empty where it can. Frame 0 fixes the gauge.

    Frames that no chain of overlaps ties to frame 0 may still be registered among each other: the
    measured poses hold them as a group. A frame that no other sees enough of is held alone.
    """
    reasons = []
    for i, frame in enumerate(problem.frames):
        others = np.delete(np.minimum(overlap[i], 1.0), i)
        if i == 0:
            reasons.append("first frame: fixes the coordinate system")
        elif frame.refused:
            reasons.append(frame.refused)
        elif len(frame) < FEWEST:
            reasons.append(f"{len(frame)} points, fewer than {FEWEST}")
        elif others.max(initial=0.0) < LEAST:
            reasons.append(
                f"no other frame sees more than {100 * others.max(initial=0.0):.1f} % of its cells"
            )
        else:
            reasons.append("")
    return reasons
