"""Where the points of a frame meet the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import kernels, map_kernels
from depthba.optimiser.asking import look
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import Loss, State, fronts_of
from depthba.optimiser.problem import Problem


@dataclass(frozen=True)
class Feet:
    """What :func:`depthba.optimiser.kernels.feet` finds of n points."""

    rows: NDArray[np.float64]
    """(ROWS, n), in the order that they have in a chunk."""
    cells: NDArray[np.int32]
    """(2, n), x and y of the cell."""

    @property
    def on(self) -> NDArray[np.float64]:
        """(n,), 1 on the map, else 0."""
        return self._rows(kernels.ON).ravel()

    @property
    def fractions(self) -> NDArray[np.float64]:
        """(2, n), x and y within the cell."""
        return self._rows(kernels.FRACTION_X, 2)

    @property
    def arms(self) -> NDArray[np.float64]:
        """(3, n), from the sensor's centre, map axes, m."""
        return self._rows(kernels.ARM_X, 3)

    @property
    def residuals(self) -> NDArray[np.float64]:
        """(n,); over the root of ``norm2`` a distance in metres."""
        return self._rows(kernels.RESIDUAL).ravel()

    @property
    def norm2(self) -> NDArray[np.float64]:
        """(n,)."""
        return self._rows(kernels.NORM2).ravel()

    @property
    def slopes(self) -> NDArray[np.float64]:
        """(2, n), the map's gradient."""
        return self._rows(kernels.SLOPE_X, 2)

    def _rows(self, begin: int, count: int = 1) -> NDArray[np.float64]:
        """Return the rows that begin at a place of a chunk."""
        first = begin // kernels.CHUNK
        return self.rows[first : first + count]


class Ground:
    """A map that points are to be put on, at the poses of a state."""

    def __init__(self, problem: Problem, grid: Grid, state: State, loss: Loss) -> None:
        """Take the gradients of the map.

        Args:
            problem: the points.
            grid: where the nodes stand.
            state: poses and heights.
            loss: how the residual is taken.
        """
        self.problem, self.grid, self.state, self.loss = problem, grid, state, loss
        self.nodes = np.empty((*grid.shape, 3))
        map_kernels.nodal_rows(state.heights, grid.spacing, self.nodes, 0, len(state.heights))
        self._fronts = fronts_of(problem, state.T_map_camera)

    def feet(self, i: int, stride: int = 1) -> Feet:
        """Return where every ``stride``-th point of frame ``i`` meets the map."""
        look()
        points = np.ascontiguousarray(self.problem.frames[i].points[::stride])
        T = self.state.T_map_camera[i]
        rows = np.empty((kernels.ROWS, len(points)))
        cells = np.empty((2, len(points)), np.int32)
        kernels.feet(
            points, T[:3, :3].copy(), T[:3, 3].copy(), self.grid.origin, self.grid.spacing,
            self.nodes, self.loss.along_ray, self.loss.slope, self._fronts[i], self.loss.cap,
            rows, cells,
        )  # fmt: skip
        return Feet(rows, cells)
