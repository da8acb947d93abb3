"""Lays patches over points: finds in which voxels several frames see something with a side.

Points are sorted into voxels; which way a patch faces is read from the scatter *within* frames,
which misaligned poses do not blur. Frames that see it from one side and from the other see two
surfaces: a thin wall would else draw them together by its thickness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import laying_kernels, patch_points
from depthba.optimiser.asking import look
from depthba.optimiser.patches import Fit, Patches
from depthba.optimiser.problem import Problem
from depthba.optimiser.workers import Workers

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Fewest points of a frame in a patch, and fewest frames.
FEWEST, SEVERAL = 6, 2
# The second axis of a patch is at least this many times its thickness, and this share of the voxel.
FLAT, WIDE = 2.0, 0.1
# How far a point is walked to its surface at most, in sides of its voxel.
REACH = 0.5
# Voxels of the box around all points, per point, above which they are sorted and not counted.
SPARSE = 8.0
# Rounds of reweighting in a fit that starts from nothing.
AFRESH = 4


@dataclass(frozen=True)
class Cloud:
    """Points of all frames, some of which may lie on patches."""

    points: NDArray[np.float32]
    """(n, 3), sensor frame, m."""
    weights: Array
    """(n,), inverse variance relative to the typical one, as far as the point counts."""
    frame: NDArray[np.int32]
    """(n,)."""
    source: NDArray[np.int32]
    """(n,), index of each point among those of its frame."""
    rays: bool
    """Whether to take residuals along rays from the origin of their sensor."""
    sided: bool
    """Whether points were seen from that origin, which tells the sides of a surface apart."""

    @staticmethod
    def of(problem: Problem) -> Cloud:
        """Return all points of a problem."""
        sizes = [len(f) for f in problem.frames]
        return Cloud(
            np.concatenate([f.points for f in problem.frames]),
            np.concatenate([f.share * f.inverse_noise.astype(float) ** 2 for f in problem.frames]),
            np.repeat(np.arange(len(sizes), dtype=np.int32), sizes),
            np.concatenate([np.arange(n, dtype=np.int32) for n in sizes]),
            problem.origin,
            problem.origin,
        )

    def weighed(self, factor: Array, workers: Workers) -> Cloud:
        """Return the points with their weights times a factor (n,), without those of none."""
        if not (factor > 0).all():
            k = np.flatnonzero(factor > 0)
            return self.taken(k, workers).weighed(factor[k], workers)
        return replace(self, weights=factor * self.weights)

    def taken(self, these: Ints, workers: Workers) -> Cloud:
        """Return some of the points, (m,), in that order."""
        n = len(these)
        points, weights = np.empty((n, 3), np.float32), np.empty(n)
        frame, source = np.empty(n, np.int32), np.empty(n, np.int32)
        workers.over(
            n, laying_kernels.gather, these, self.points, self.weights, self.frame, self.source,
            points, weights, frame, source,
        )  # fmt: skip
        return replace(self, points=points, weights=weights, frame=frame, source=source)


def lay(
    cloud: Cloud, T_map_camera: Array, sides: tuple[float, ...], robust: float, sigma: float,
    workers: Workers,
) -> Fit:  # fmt: skip
    """Lay patches over points, in voxels of the first side; where there is none, of the next.

    Args:
        cloud: the points.
        T_map_camera: (N, 4, 4), where to lay them.
        sides: of the voxels, m, descending.
        robust: scale of the loss, in robust standard deviations of the residuals.
        sigma: standard deviation of the points' noise, m.
        workers: the threads.
    """
    n = len(T_map_camera)
    x = np.empty(cloud.points.shape)
    workers.over(len(x), laying_kernels.to_map, cloud.points, cloud.frame, T_map_camera, x)
    left, parts = np.arange(len(x)), []
    for side in sides:
        look()
        parts.append(_voxels(x, cloud, T_map_camera[:, :3, 3], left, side, workers))
        left = parts[-1].left
    order = np.concatenate([p.points for p in parts])
    taken = cloud.taken(order, workers)
    each = np.repeat(sides, [len(p.centre) for p in parts])
    laid = Patches(
        points=taken.points,
        weights=taken.weights,
        source=taken.source,
        ends=_ends([p.sizes for p in parts]),
        frame=np.concatenate([p.frame for p in parts]),
        views=_ends([p.views for p in parts]),
        axes=np.concatenate([p.axes for p in parts]),
        centre=np.concatenate([p.centre for p in parts]),
        reach=REACH * each,
        stiff=(sigma * each) ** 2,
        surface=np.zeros((len(each), patch_points.TERMS)),
        robust=robust,
        scale=0.0,
        rays=cloud.rays,
        frames=n,
    )
    fit = Fit(laid, 0.0, np.zeros(len(order)))
    for _ in range(AFRESH):
        fit = fit.patches.fitted(T_map_camera, workers, 1).rescaled(sigma)
    return fit


def _ends(sizes: list[Ints]) -> Ints:
    """Return where runs of the given sizes end, and a 0 before them."""
    return np.concatenate([[0], np.cumsum(np.concatenate(sizes))])


@dataclass(frozen=True)
class _Found:
    """Patches in voxels of one side."""

    points: Ints
    """(n,), indices of the points on patches, by patch and by frame."""
    sizes: Ints
    """(m,), points of each view."""
    frame: NDArray[np.int32]
    """(m,), its frame."""
    views: Ints
    """(k,), views of each patch."""
    axes: Array
    """(k, 3, 3)."""
    centre: Array
    """(k, 3)."""
    left: Ints
    """Indices of the points on none, ascending."""


def _voxels(
    x: Array, cloud: Cloud, cameras: Array, these: Ints, side: float, workers: Workers
) -> _Found:
    """Find patches among some of the points x (n, 3), ascending, in voxels of the given side, m.

    ``cameras`` (N, 3) stand there.
    """
    if not len(these):
        none = np.empty(0, np.int64)
        return _Found(
            none, none, none.astype(np.int32), none, np.empty((0, 3, 3)), np.empty((0, 3)), these
        )
    key, k = _voxel_of(x, these, side, workers)
    order, ends = np.empty_like(these), np.zeros(k + 1, np.int64)
    laying_kernels.sort_by(key, these, order, ends)
    look()
    begins, voxel = np.empty(len(order) + 1, np.int64), np.empty(len(order), np.int64)
    m, k = laying_kernels.split(order, ends, cloud.frame, begins, voxel)
    begins[m] = len(order)
    begins, voxel = begins[: m + 1], voxel[:m]
    frame = cloud.frame[order[begins[:-1]]]
    weight, mean, spread = np.empty(m), np.empty((m, 3)), np.empty((m, 3, 3))
    workers.over(m, laying_kernels.moments, order, begins, x, cloud.weights, weight, mean, spread)
    look()
    many = np.diff(begins) >= FEWEST
    several = np.bincount(voxel[many], minlength=k) >= SEVERAL
    many &= several[voxel]
    # from here on of the voxels that several frames see
    on, k = (np.cumsum(several) - 1)[voxel[many]], int(several.sum())
    total, pooled = np.bincount(on, weight[many], k), np.zeros((k, 3, 3))
    laying_kernels.pool(on, spread[many], pooled)
    values, axes = np.empty((k, 3)), np.empty((k, 3, 3))
    workers.over(k, laying_kernels.principal, pooled, values, axes)
    good = (values[:, 1] > FLAT**2 * values[:, 0]) & (values[:, 1] > total * (WIDE * side) ** 2)
    views = np.flatnonzero(many)[good[on]]
    patch = on[good[on]]
    if cloud.sided:
        middle = _means(patch, weight[views], mean[views], k)
        from_there = cameras[frame[views]] - middle[patch]
        patch = 2 * patch + (np.einsum("ij,ij->i", from_there, axes[patch, :, 0]) > 0)
        axes = np.repeat(axes, 2, axis=0)
        # a patch's views are one run; by frame, as they came
        by_patch = np.argsort(patch, kind="stable")
        views, patch = views[by_patch], patch[by_patch]
    count = np.bincount(patch, minlength=len(axes))
    views, patch = views[count[patch] >= SEVERAL], patch[count[patch] >= SEVERAL]
    used = np.flatnonzero(count >= SEVERAL)
    sizes = np.diff(begins)[views]
    taken = np.empty(sizes.sum(), np.int64)
    laying_kernels.runs(order, begins, views, taken)
    rest = np.zeros(len(x), bool)
    rest[these] = True
    rest[taken] = False
    return _Found(
        taken,
        sizes,
        frame[views],
        count[used],
        axes[used],
        _means(patch, weight[views], mean[views], len(axes))[used],
        np.flatnonzero(rest),
    )


def _means(group: Ints, weight: Array, mean: Array, count: int) -> Array:
    """Return the weighted mean (count, 3) of means (n, 3) by group (n,)."""
    total = np.maximum(np.bincount(group, weight, count), 1e-300)
    sums = [np.bincount(group, weight * mean[:, a], count) for a in range(3)]
    return np.stack(sums, axis=1) / total[:, None]


def _voxel_of(x: Array, these: Ints, side: float, workers: Workers) -> tuple[Ints, int]:
    """Return the number of some points' voxels, in order, and one more than the last."""

    def extent(band: tuple[int, int]) -> tuple[Array, Array]:
        least, most = np.empty(3), np.empty(3)
        laying_kernels.extent(*band, x, these, least, most)
        return least, most

    extents = np.array(workers.map(extent, workers.bands(len(these))))
    least = np.floor(extents[:, 0].min(axis=0) / side).astype(np.int64)
    spans = np.floor(extents[:, 1].max(axis=0) / side).astype(np.int64) + 1 - least
    key = np.empty_like(these)
    workers.over(len(key), laying_kernels.number, x, these, side, least, spans, key)
    count = float(np.prod(spans.astype(float)))
    if count <= SPARSE * len(key):
        return key, int(count)
    used, numbers = np.unique(key, return_inverse=True)
    return numbers, len(used)
