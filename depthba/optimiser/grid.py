"""The grid of a level: where its nodes stand, and the heights it begins with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, map_coordinates

from depthba.errors import OptionError
from depthba.optimiser import map_kernels
from depthba.optimiser.asking import look
from depthba.optimiser.problem import Problem

# Above this the map alone would need gigabytes: more likely a spacing in the wrong unit.
LARGEST = 30_000_000


@dataclass(frozen=True)
class Grid:
    """Nodes at ``origin + spacing * (x, y)``, (ny, nx) of them."""

    origin: NDArray[np.float64]
    spacing: float
    shape: tuple[int, int]


def make_grid(problem: Problem, spacing: float, margin: float) -> Grid:
    """Return a grid that covers the problem's points and ``margin`` metres around them.

    Raises:
        OptionError: so fine a grid would not fit into memory.
    """
    low = np.floor((problem.lower - margin) / spacing) - 3
    high = np.ceil((problem.upper + margin) / spacing) + 3
    nx, ny = (high - low).astype(int) + 1
    if nx * ny > LARGEST:
        raise OptionError(
            f"--resolution {spacing:g} m: the map would have {nx} x {ny} nodes, "
            f"more than {LARGEST}; use a larger spacing or a smaller --roi"
        )
    return Grid(low * spacing, spacing, (int(ny), int(nx)))


@dataclass(frozen=True)
class Averages:
    """What falls on the nodes at given poses, all (ny, nx)."""

    heights: NDArray[np.float64]
    """Mean height of the points nearest to the node; NaN without points."""
    count: NDArray[np.float64]


def average(problem: Problem, T_map_camera: NDArray[np.float64], grid: Grid) -> Averages:
    """Average the points' heights node by node, as the paper initialises its map."""
    total, count = np.zeros(grid.shape), np.zeros(grid.shape)
    for frame, T in zip(problem.frames, T_map_camera, strict=True):
        look()
        map_kernels.splat(
            frame.points, T[:3, :3].copy(), T[:3, 3].copy(), grid.origin, grid.spacing, total, count
        )
    heights = np.full(grid.shape, np.nan)
    np.divide(total, count, out=heights, where=count > 0)
    return Averages(heights, count)


def filled(heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the heights with every NaN replaced by the nearest known height."""
    unknown = np.isnan(heights)
    if not unknown.any():
        return heights.copy()
    if unknown.all():
        return np.zeros_like(heights)
    nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return np.asarray(heights[tuple(nearest)])


def near(seen: NDArray[np.bool_], nodes: int) -> NDArray[np.bool_]:
    """Return the nodes within ``nodes`` steps of a seen one."""
    return np.asarray(binary_dilation(seen, np.ones((3, 3), bool), iterations=nodes))


def resample(heights: NDArray[np.float64], old: Grid, new: Grid) -> NDArray[np.float64]:
    """Interpolate heights bilinearly onto another grid; beyond the old grid its border goes on."""
    y = (new.origin[1] + new.spacing * np.arange(new.shape[0]) - old.origin[1]) / old.spacing
    x = (new.origin[0] + new.spacing * np.arange(new.shape[1]) - old.origin[0]) / old.spacing
    where = np.meshgrid(y, x, indexing="ij")
    return np.asarray(map_coordinates(heights, where, order=1, mode="nearest"))
