"""How well frames agree: the spread of their heights, cell by cell. Needs no truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MAD_TO_SIGMA = 1.4826
"""Makes the median absolute deviation of a normal distribution its standard deviation."""


@dataclass(frozen=True)
class CellHeights:
    """The mean heights of one frame, for the cells that it sees."""

    cells: NDArray[np.int64]
    """(k,), rising cell numbers, ``ix * ny + iy``."""
    heights: Floats
    """(k,), metres."""


@dataclass(frozen=True)
class CellSpread:
    """Spread between the frames' heights over a regular grid of cells."""

    cell: float
    """Edge of a cell, metres."""
    origin: tuple[float, float]
    """Map x and y of the corner of cell (0, 0), metres."""
    shape: tuple[int, int]
    """(ny, nx)."""
    frames: tuple[CellHeights, ...]
    seen: NDArray[np.int64]
    """(m,), the cells that any frame sees, rising."""
    views: NDArray[np.int64]
    """(m,), number of frames that see the cell."""
    spread: Floats
    """(m,), 1.4826 x median absolute deviation of the heights, metres; NaN below two views."""

    @property
    def shared(self) -> Floats:
        """The spreads of the cells that two or more frames see, metres."""
        return np.asarray(self.spread[self.views >= 2])

    def quantile(self, q: float) -> float:
        """Return quantile ``q`` in 0..1 of the shared cells' spread, metres; NaN without such."""
        return float(np.quantile(self.shared, q)) if len(self.shared) else float("nan")

    def image(self) -> Floats:
        """Return the spread as (ny, nx), metres; NaN where fewer than two frames see the cell."""
        ny, nx = self.shape
        flat = np.full(nx * ny, np.nan)
        flat[self.seen] = self.spread
        return np.ascontiguousarray(flat.reshape(nx, ny).T)


def cell_spread(points_map: Sequence[Floats], cell: float) -> CellSpread:
    """Compare the frames' mean heights in each cell of a grid.

    Args:
        points_map: per frame (n_i, 3), metres, in a frame whose z axis is the height.
        cell: edge of the cells, metres.

    Returns:
        The spread per cell; the grid begins at the smallest x and y of all points.

    """
    whole = [p for p in points_map if len(p)]
    if not whole:
        nothing = np.zeros(0, np.int64)
        none = CellHeights(nothing, np.zeros(0))
        frames = tuple(none for _ in points_map)
        return CellSpread(cell, (0.0, 0.0), (0, 0), frames, nothing, nothing, np.zeros(0))
    low = np.min([p[:, :2].min(axis=0) for p in whole], axis=0)
    high = np.max([p[:, :2].max(axis=0) for p in whole], axis=0)
    nx, ny = (int(n) + 2 for n in (high - low) / cell)
    frames = tuple(_cell_heights(p, low, cell, ny) for p in points_map)
    seen, views, spread = _robust_spread(
        np.concatenate([f.cells for f in frames]), np.concatenate([f.heights for f in frames])
    )
    spread[views < 2] = np.nan
    return CellSpread(cell, (float(low[0]), float(low[1])), (ny, nx), frames, seen, views, spread)


def _cell_heights(p: Floats, low: Floats, cell: float, ny: int) -> CellHeights:
    """Average the heights of one frame per cell."""
    if not len(p):
        return CellHeights(np.zeros(0, np.int64), np.zeros(0))
    k = np.floor((p[:, :2] - low) / cell).astype(np.int64)
    number = k[:, 0] * ny + k[:, 1]
    first = number.min()  # counting from the frame's own first cell keeps the arrays short
    count = np.bincount(number - first)
    total = np.bincount(number - first, p[:, 2])
    hit = np.flatnonzero(count)
    return CellHeights(hit + first, total[hit] / count[hit])


def _robust_spread(
    cells: NDArray[np.int64], heights: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Return the cells, their numbers of entries and the spread of each."""
    seen, first, views = np.unique(np.sort(cells), return_index=True, return_counts=True)
    group = np.repeat(np.arange(len(seen)), views)
    heights = heights[np.argsort(cells, kind="stable")]

    def medians(values: Floats) -> Floats:
        ordered = values[np.lexsort((values, group))]
        lower, upper = ordered[first + (views - 1) // 2], ordered[first + views // 2]
        return np.asarray(0.5 * (lower + upper))

    deviation = np.abs(heights - medians(heights)[group])
    return seen, views, MAD_TO_SIGMA * medians(deviation)
