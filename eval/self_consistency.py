"""How well the frames agree with each other: measures that need no truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from depthba import se3
from depthba.clouds import inside, thin, transform
from depthba.dataset import Dataset
from depthba.spread import CellSpread, cell_spread
from eval.metrics import Metric

Floats = NDArray[np.float64]

MIN_OVERLAP = 0.15
"""Two frames overlap when they share this part of the smaller one's cells."""
NEIGHBOURS = 15
"""Points that a normal is fitted to, the point itself among them."""
REACH = 3.0
"""Correspondences are closer than this many cells."""
SAMPLES = 4000
"""About so many points of a frame are compared with another frame."""
MIN_PAIRED = 50
"""Fewer correspondences say nothing about a pair."""
MIN_POINTS = 20
"""A frame with no more averaged points has no surface to compare with."""


@dataclass(frozen=True)
class Agreement:
    """How well the frames agree at some poses."""

    spread: CellSpread
    pairs: tuple[tuple[int, int, float], ...]
    """Overlapping pairs: indices i < j and the median point-to-plane distance, metres."""

    def metrics(self) -> list[Metric]:
        """Return spread and point-to-plane distance as metrics."""
        distances = np.array([d for *_, d in self.pairs])
        middle = float(np.median(distances)) if len(distances) else float("nan")
        worst = float(distances.max()) if len(distances) else float("nan")
        return [
            Metric("spread_median", "m", "lower", self.spread.quantile(0.5)),
            Metric("spread_p90", "m", "lower", self.spread.quantile(0.9)),
            Metric("point_to_plane_median", "m", "lower", middle),
            Metric("point_to_plane_worst_pair", "m", "lower", worst),
        ]


def agreement(
    points: Sequence[Floats],
    T_world_camera: Floats,
    R_map_world: Floats,
    cell: float,
    *,
    roi: Sequence[float] | None = None,
    T_map_world: Floats | None = None,
) -> Agreement:
    """Measure how well the frames agree at given poses.

    Args:
        points: per frame (n_i, 3), sensor frame, metres.
        T_world_camera: (N, 4, 4).
        R_map_world: (3, 3), its rows are the axes of the cells and, last, of the heights.
        cell: edge of the cells, metres.
        roi: xmin xmax ymin ymax zmin zmax; points outside are left out.
        T_map_world: (4, 4), into the frame of ``roi``; None: the world.

    """
    into = np.eye(4) if T_map_world is None else T_map_world
    world = []
    for p, T in zip(points, T_world_camera, strict=True):
        p_world = transform(T, p)
        if roi is not None:
            p_world = p_world[inside(transform(into, p_world), roi)]
        world.append(p_world)
    turn = se3.make(R_map_world, np.zeros(3))
    spread = cell_spread([transform(turn, p) for p in world], cell)
    return Agreement(spread, _point_to_plane(world, [f.cells for f in spread.frames], cell))


def _point_to_plane(
    world: Sequence[Floats], cells: Sequence[NDArray[np.int64]], cell: float
) -> tuple[tuple[int, int, float], ...]:
    """Compare all overlapping pairs: median distance of one's points from the other's planes."""
    surfaces = [_Surface(p, cell) for p in world]
    pairs = []
    for j, target in enumerate(surfaces):
        for i in range(j):
            smaller = min(len(cells[i]), len(cells[j]))
            shared = len(np.intersect1d(cells[i], cells[j], assume_unique=True))
            if not surfaces[i].usable or not target.usable or shared < MIN_OVERLAP * smaller:
                continue
            distances = target.distances(surfaces[i].sample(), REACH * cell)
            if len(distances) >= MIN_PAIRED:
                pairs.append((i, j, float(np.median(distances))))
    return tuple(sorted(pairs))


class _Surface:
    """One frame's points, averaged per cube, with normals once they are asked for."""

    def __init__(self, points: Floats, cell: float) -> None:
        self.points = thin(points, cell)
        self.usable = len(self.points) > MIN_POINTS
        self._normals: Floats | None = None
        if self.usable:
            self._tree = cKDTree(self.points)

    def sample(self) -> Floats:
        return self.points[:: max(1, len(self.points) // SAMPLES)]

    def distances(self, points: Floats, reach: float) -> Floats:
        """Return distances from the plane at the nearest point, where that is in ``reach``."""
        distance, nearest = self._tree.query(points, distance_upper_bound=reach, workers=-1)
        near = np.isfinite(distance)
        at = nearest[near]
        return np.abs(np.einsum("nk,nk->n", points[near] - self.points[at], self._normal()[at]))

    def _normal(self) -> Floats:
        if self._normals is None:
            around = self.points[self._tree.query(self.points, k=NEIGHBOURS, workers=-1)[1]]
            around = around - around.mean(axis=1, keepdims=True)
            scatter = np.einsum("nki,nkj->nij", around, around)
            self._normals = np.linalg.eigh(scatter)[1][:, :, 0]
        return self._normals


def map_rotation(dataset: Dataset, T_world_camera: Floats) -> Floats:
    """Return the axes that heights are compared in, as rows (3, 3).

    The world's own where the dataset says so, else z against the mean viewing direction.
    """
    if dataset.map_frame == "world":
        return np.eye(3)
    up = -T_world_camera[:, :3, 2].mean(axis=0)
    up /= np.linalg.norm(up)
    across = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    across -= up * (up @ across)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(up, across), up])
