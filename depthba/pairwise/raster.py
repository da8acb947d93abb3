"""Height maps of single frames, and the relief that a tilt of the frame does not change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from depthba.compiling import kernel

Floats = NDArray[np.float64]

# Cells along the side of a square as large as a typical frame's footprint.
ACROSS = 44
# Most cells along the side of a raster.
MOST = 192
# Cells over which the mean surface is taken that the relief stands out from (standard deviation of
# the Gaussian window).
WINDOW = 5.0
# Relief beyond this many robust standard deviations is cut: the rims of high things, seen from two
# sides, are not equal.
CUT = 3.0


@dataclass(frozen=True)
class Lattice:
    """A square raster about a frame's own centre; equal for all frames."""

    cell: float
    """m."""
    side: int
    """Cells along a side; a cell's centre is at a multiple of ``cell`` from the middle one."""


@dataclass(frozen=True)
class Raster:
    """Heights above the map plane, relative to the centre of the frame."""

    heights: NDArray[np.float32]
    """(side, side), row y, column x; 0 where unseen."""
    seen: NDArray[np.bool_]
    """(side, side)."""


def lattice_for(clouds: list[Floats], spacing: float) -> Lattice:
    """Choose cells that suit the frames' footprints.

    Args:
        clouds: (n, 3) each, metres, x and y along the map plane, about the frame's centre.
        spacing: distance of neighbouring points, m: a cell holds a few.
    """
    filled = [p for p in clouds if len(p)]
    areas = [float(np.prod(np.quantile(p[:, :2], 0.98, 0) - np.quantile(p[:, :2], 0.02, 0)))
             for p in filled]  # fmt: skip
    reach = max(float(np.quantile(np.linalg.norm(p[:, :2], axis=1), 0.995)) for p in filled)
    cell = max(np.sqrt(np.median(areas)) / ACROSS, 2 * spacing, 2 * reach / MOST)
    return Lattice(float(cell), 2 * int(np.ceil(reach / cell)) + 1)


def rasterise(points: Floats, lattice: Lattice) -> Raster:
    """Return the mean height of the points (n, 3) of each cell."""
    sums = np.zeros((lattice.side, lattice.side))
    counts = np.zeros((lattice.side, lattice.side))
    _splat(points, lattice.cell, sums, counts)
    seen = counts > 0
    return Raster((sums / np.maximum(counts, 1)).astype(np.float32), seen)


def relief(raster: Raster) -> NDArray[np.float32]:
    """Return what stands out from the mean surface about it (side, side), cut and 0 where unseen.

    Planes vanish, so an error of the frame's height, roll or pitch leaves it as it is.
    """
    if not raster.seen.any():
        return np.zeros(raster.heights.shape, np.float32)
    heights = np.where(raster.seen, raster.heights - _plane(raster), 0.0).astype(np.float32)
    weight = ndimage.gaussian_filter(raster.seen.astype(np.float32), WINDOW)
    out = heights - ndimage.gaussian_filter(heights, WINDOW) / np.maximum(weight, 1e-6)
    scale = CUT * 1.4826 * float(np.median(np.abs(out[raster.seen])))
    return np.asarray(np.where(raster.seen, np.clip(out, -scale, scale), 0.0), np.float32)


def _plane(raster: Raster) -> Floats:
    """Return the heights (side, side) of the plane of least squares.

    At the rim of what is seen the mean about a cell is that of one side: a slope would stand out.
    """
    y, x = (np.arange(raster.heights.shape[k]) - raster.heights.shape[k] // 2 for k in (0, 1))
    row, column = np.nonzero(raster.seen)
    A = np.stack([np.ones(len(row)), x[column], y[row]], axis=1)
    z = raster.heights[raster.seen].astype(float)
    a, b, c = np.linalg.solve(A.T @ A + 1e-9 * np.eye(3), A.T @ z)
    return np.asarray(a + b * x[None, :] + c * y[:, None])


@kernel
def _splat(points, cell, sums, counts):  # type: ignore[no-untyped-def]
    side = sums.shape[0]
    half = side // 2
    for k in range(len(points)):
        x = int(np.floor(points[k, 0] / cell + 0.5)) + half
        y = int(np.floor(points[k, 1] / cell + 0.5)) + half
        if 0 <= x < side and 0 <= y < side:
            sums[y, x] += points[k, 2]
            counts[y, x] += 1.0
