"""Figures of merit of maps and clouds, with a true surface and without.

Heights are compared along the map's z axis, clouds by the distance to the nearest point. Without
truth, how sharp the frames' common cloud is: mean map entropy and the thickness of planar patches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from depthba.clouds import transform
from eval.metrics import Metric

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

REACHES = (1, 2, 5)
"""A node counts as complete where its height is right to so many spacings."""
COMPARED = 50_000
"""Points of each cloud that the distance to the other is taken of, at most."""
KEPT = 200_000
"""Points of all frames together whose sharpness is judged, at most."""
PLACES = 1000
"""Neighbourhoods in which it is judged, at most."""
FEWEST = 15
"""A neighbourhood with fewer points says nothing."""
PLANAR = 1 / 9
"""A patch is planar when the least eigenvalue of its covariance is below this part of the next."""


def height_metrics(
    heights: Floats, true_heights: Floats, expected: Bools, spacing: float
) -> list[Metric]:
    """Judge a map's heights by the true ones.

    Args:
        heights: (ny, nx), m; NaN where the map has none.
        true_heights: (ny, nx), m, at the same nodes; NaN where there is no surface.
        expected: (ny, nx), whether the map should have a height there.
        spacing: of the nodes, m.

    Returns:
        Root mean square and 95th percentile of the vertical error over all nodes that have both
        heights and are expected; the shares of the expected nodes with a true height at which the
        map's is right to 1, 2 and 5 spacings: completeness.

    """
    wanted = expected & np.isfinite(true_heights)
    errors = np.abs(heights - true_heights)[wanted]
    known = errors[np.isfinite(errors)]
    return [
        Metric("map_rmse", "m", "lower", _root_mean_square(known)),
        Metric("map_p95", "m", "lower", _quantile(known, 0.95)),
        *(
            Metric(
                f"map_complete_{k}x",
                "1",
                "higher",
                float(np.mean(errors <= k * spacing)) if errors.size else float("nan"),
            )
            for k in REACHES
        ),
    ]


def cloud_metrics(points: Floats, true_points: Floats) -> list[Metric]:
    """Compare clouds (n, 3) and (m, 3), m: mean distance to the nearest true point, and Chamfer.

    Chamfer is the sum of the mean distances both ways, not squared. Of a large cloud an even part
    is asked; the nearest point is sought among all.
    """
    there, back = _nearest(points, true_points), _nearest(true_points, points)
    return [
        Metric("cloud_to_cloud", "m", "lower", there),
        Metric("chamfer", "m", "lower", there + back),
    ]


@dataclass(frozen=True)
class Patches:
    """Neighbourhoods in the common cloud of all frames."""

    eigenvalues: Floats
    """(k, 3), of the points' covariances, rising, m^2."""
    frames: NDArray[np.int64]
    """(k,), how many frames have points there."""

    def metrics(self) -> list[Metric]:
        """Return mean map entropy and the thickness of planar patches."""
        shared = self.eigenvalues[self.frames >= 2]
        planar = shared[shared[:, 0] < PLANAR * shared[:, 1]]
        thickness = np.sqrt(np.maximum(planar[:, 0], 0.0))
        return [
            Metric("mean_map_entropy", "1", "lower", self.entropy()),
            Metric("patch_thickness", "m", "lower", _quantile(thickness, 0.5)),
        ]

    def entropy(self) -> float:
        """Return the mean of ln det(2 pi e covariance) / 2, lengths in metres.

        Droeschel and Behnke, Efficient Continuous-time SLAM for 3D Lidar-based Online Mapping
        (ICRA 2018). Neighbourhoods without volume are left out.
        """
        solid = self.eigenvalues[self.eigenvalues[:, 0] > 0]
        if not len(solid):
            return float("nan")
        return float(np.mean(0.5 * np.log(2 * np.pi * np.e * solid).sum(axis=1)))


def patches(points: Sequence[Floats], T_world_camera: Floats, radius: float) -> Patches:
    """Cut neighbourhoods out of the common cloud of all frames.

    Args:
        points: per frame (n_i, 3), sensor frame, m.
        T_world_camera: (N, 4, 4).
        radius: of a neighbourhood, m.

    """
    rng = np.random.default_rng(0)
    cloud = np.concatenate([transform(T, p) for T, p in zip(T_world_camera, points, strict=True)])
    frame = np.repeat(np.arange(len(points)), [len(p) for p in points])
    keep = _some(len(cloud), KEPT, rng)
    cloud, frame = cloud[keep], frame[keep]
    nothing = Patches(np.empty((0, 3)), np.empty(0, np.int64))
    if not len(cloud):
        return nothing
    centres = cloud[_some(len(cloud), PLACES, rng)]
    near = cKDTree(cloud).query_ball_point(centres, radius, workers=-1)
    near = [np.asarray(n) for n in near if len(n) >= FEWEST]
    if not near:
        return nothing
    covariances = np.empty((len(near), 3, 3))
    for k, n in enumerate(near):
        around = cloud[n] - cloud[n].mean(axis=0)
        covariances[k] = around.T @ around / len(n)
    views = [np.count_nonzero(np.bincount(frame[n])) for n in near]
    return Patches(np.asarray(np.linalg.eigvalsh(covariances), float), np.array(views, np.int64))


def seen_nodes(
    world: Sequence[Floats],
    T_map_world: Floats,
    origin: tuple[float, float],
    spacing: float,
    shape: tuple[int, int],
) -> Bools:
    """Return the nodes (ny, nx) that have a point within half a spacing in x and in y.

    Args:
        world: clouds (n_i, 3), m.
        T_map_world: (4, 4).
        origin: map x and y of node [0, 0], m.
        spacing: of the nodes, m.
        shape: (ny, nx).

    """
    ny, nx = shape
    seen = np.zeros(ny * nx, dtype=bool)
    for points in world:
        k = np.rint((transform(T_map_world, points)[:, :2] - origin) / spacing).astype(np.int64)
        k = k[((k >= 0) & (k < [nx, ny])).all(axis=1)]
        seen[k[:, 1] * nx + k[:, 0]] = True
    return seen.reshape(shape)


def _nearest(points: Floats, others: Floats) -> float:
    """Return the mean distance of points to the nearest of the others, m."""
    if not len(points) or not len(others):
        return float("nan")
    asked = points[_some(len(points), COMPARED, np.random.default_rng(0))]
    return float(cKDTree(others).query(asked, workers=-1)[0].mean())


def _some(count: int, most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return rising indices: all, or ``most`` of them at random."""
    if count <= most:
        return np.arange(count)
    return np.sort(rng.choice(count, most, replace=False, shuffle=False))


def _root_mean_square(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _quantile(values: Floats, q: float) -> float:
    return float(np.quantile(values, q)) if values.size else float("nan")
