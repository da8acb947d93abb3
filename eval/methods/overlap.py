"""Which frames see the same ground: the pairs that pairwise methods register."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from depthba.clouds import transform
from depthba.optimiser.start import pose_sigmas
from depthba.options import Options
from depthba.picture import CELL_SPACINGS
from eval.methods.method import Task
from eval.self_consistency import map_rotation

Floats = NDArray[np.float64]

LEAST = 0.25
"""Two frames overlap when they share this part of the smaller one's cells."""
SIGMAS = 3.0
"""Heights in a cell may differ by this many standard deviations of the start's error."""


def overlapping_pairs(task: Task, least: float = LEAST) -> list[tuple[int, int]]:
    """Return the pairs i < j of frames that overlap at the start poses.

    A cell of a grid in the map plane, four point spacings wide, is shared when both frames have
    points in it at heights that the error of the start poses can make one: what two cameras see
    of the two sides of a thing is no overlap. A grid in space would ask the same of all three
    axes, where a start that is off by millimetres loses half of the pairs and a grid coarse enough
    to forgive it takes in many that hardly overlap.

    Args:
        task: frames and start poses.
        least: share of the smaller frame's cells that the other must see too.

    """
    shares = overlap(task)
    return [(i, j) for i, j in combinations(range(len(task)), 2) if shares[i, j] >= least]


def overlap(task: Task) -> Floats:
    """Return (N, N), the cells that two frames share over those of the smaller one.

    Symmetric; 1 on the diagonal, 0 where a frame has no points.
    """
    R_map_world = map_rotation(task.dataset, task.T_world_camera)
    cell = CELL_SPACINGS * task.spacing
    tolerance = SIGMAS * np.sqrt(2.0) * displacement(task)
    columns = []
    for points, T in zip(task.clouds, task.T_world_camera, strict=True):
        columns.append(_columns(transform(T, points) @ R_map_world.T, cell))
    shares = np.zeros((len(task), len(task)))
    for i, (cells_i, low_i, high_i) in enumerate(columns):
        for j, (cells_j, low_j, high_j) in enumerate(columns[: i + 1]):
            _, a, b = np.intersect1d(cells_i, cells_j, assume_unique=True, return_indices=True)
            gap = np.maximum(low_i[a] - high_j[b], low_j[b] - high_i[a])
            smaller = max(min(len(cells_i), len(cells_j)), 1)
            shares[i, j] = shares[j, i] = np.count_nonzero(gap <= tolerance) / smaller
    return shares


def displacement(task: Task) -> float:
    """Return by how far the start's error moves a point along one axis, standard deviation, m.

    The dataset's ``pose_noise`` where it states one, else what a registration believes; a rotation
    acts over the median distance of the points.
    """
    sigma_t, sigma_r = (
        float(np.sqrt(np.mean(np.square(sigma))))
        for sigma in pose_sigmas(task.dataset.pose_noise, Options())
    )
    reaches = [np.median(np.linalg.norm(points, axis=1)) for points in task.clouds if len(points)]
    return float(np.hypot(sigma_t, sigma_r * np.median(reaches))) if reaches else sigma_t


def _columns(points: Floats, cell: float) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Return the cells (m,) that hold points (n, 3), and their lowest and highest points, m."""
    if not len(points):
        return np.empty(0, np.int64), np.empty(0), np.empty(0)
    index = np.floor(points[:, :2] / cell).astype(np.int64)
    key = (index[:, 0] << 32) + index[:, 1]
    order = np.argsort(key)
    cells, first = np.unique(key[order], return_index=True)
    heights = points[order, 2]
    return cells, np.minimum.reduceat(heights, first), np.maximum.reduceat(heights, first)
