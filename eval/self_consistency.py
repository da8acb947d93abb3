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
NEAREST = 12
"""Points of the other frame among which one on the same face is looked for."""
SAME_FACE = 0.5
"""Least cosine between normals, both towards their sensors, of points on one face."""


@dataclass(frozen=True)
class Pair:
    """Median point-to-plane distances of a frame's points from another frame."""

    i: int
    j: int
    """Frames, i < j; the planes are of j."""
    nearest: float
    """From the planes at the nearest points, metres."""
    same_face: float
    """From those at the nearest points that face their sensor alike, metres: the two faces of a
    thin wall are not one surface. NaN where there are too few."""


@dataclass(frozen=True)
class Agreement:
    """How well the frames agree at some poses."""

    spread: CellSpread
    pairs: tuple[Pair, ...]
    """Overlapping pairs, by i, then j."""

    def metrics(self) -> list[Metric]:
        """Return spread and point-to-plane distances as metrics."""
        distances = np.array([p.nearest for p in self.pairs])
        faces = np.array([p.same_face for p in self.pairs if np.isfinite(p.same_face)])
        middle = float(np.median(distances)) if len(distances) else float("nan")
        worst = float(distances.max()) if len(distances) else float("nan")
        alike = float(np.median(faces)) if len(faces) else float("nan")
        return [
            Metric("spread_median", "m", "lower", self.spread.quantile(0.5)),
            Metric("spread_p90", "m", "lower", self.spread.quantile(0.9)),
            Metric("point_to_plane_median", "m", "lower", middle),
            Metric("point_to_plane_worst_pair", "m", "lower", worst),
            Metric("same_face_median", "m", "lower", alike),
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
    seen = [f.cells for f in spread.frames]
    return Agreement(spread, _point_to_plane(world, T_world_camera[:, :3, 3], seen, cell))


def _point_to_plane(
    world: Sequence[Floats], sensors: Floats, cells: Sequence[NDArray[np.int64]], cell: float
) -> tuple[Pair, ...]:
    """Compare all overlapping pairs: median distances of one's points from the other's planes."""
    surfaces = [_Surface(p, o, cell) for p, o in zip(world, sensors, strict=True)]
    pairs = []
    for j, target in enumerate(surfaces):
        for i in range(j):
            smaller = min(len(cells[i]), len(cells[j]))
            shared = len(np.intersect1d(cells[i], cells[j], assume_unique=True))
            if not surfaces[i].usable or not target.usable or shared < MIN_OVERLAP * smaller:
                continue
            nearest, same_face = target.distances(surfaces[i], REACH * cell)
            if len(nearest) >= MIN_PAIRED:
                enough = len(same_face) >= MIN_PAIRED
                alike = float(np.median(same_face)) if enough else float("nan")
                pairs.append(Pair(i, j, float(np.median(nearest)), alike))
    return tuple(sorted(pairs, key=lambda p: (p.i, p.j)))


class _Surface:
    """One frame's points, averaged per cube, with normals once they are asked for."""

    def __init__(self, points: Floats, sensor: Floats, cell: float) -> None:
        self.points = thin(points, cell)
        self.usable = len(self.points) > MIN_POINTS
        self._sensor = sensor
        self._normals: Floats | None = None
        if self.usable:
            self._tree = cKDTree(self.points)

    def distances(self, other: _Surface, reach: float) -> tuple[Floats, Floats]:
        """Return distances of another's points from planes of this one, within ``reach``.

        Returns:
            From the plane at the nearest point, and at the nearest one of the same face.
        """
        some = slice(None, None, max(1, len(other.points) // SAMPLES))
        points, facing = other.points[some], other.normals[some]
        distance, at = self._tree.query(points, NEAREST, distance_upper_bound=reach, workers=-1)
        near = np.isfinite(distance)
        at = np.where(near, at, 0)
        offset = points[:, None] - self.points[at]
        across = np.abs(np.einsum("nmk,nmk->nm", offset, self.normals[at]))
        alike = near & (np.einsum("nk,nmk->nm", facing, self.normals[at]) > SAME_FACE)
        first = np.argmax(alike, axis=1)
        found = across[np.arange(len(points)), first]
        return across[near[:, 0], 0], found[alike.any(axis=1)]

    @property
    def normals(self) -> Floats:
        """(n, 3), unit, towards the sensor."""
        if self._normals is None:
            around = self.points[self._tree.query(self.points, k=NEIGHBOURS, workers=-1)[1]]
            around = around - around.mean(axis=1, keepdims=True)
            scatter = np.einsum("nki,nkj->nij", around, around)
            normals = np.linalg.eigh(scatter)[1][:, :, 0]
            away = np.einsum("nk,nk->n", normals, self.points - self._sensor) > 0
            self._normals = np.where(away[:, None], -normals, normals)
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
