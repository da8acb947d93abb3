"""Quadric patches in 3-D, seen by several frames: what steep and small things say about the poses.

The map holds one height per node. Walls, edges and small things it can only blur; and where the
rest is flat, they are all that holds the frames sideways. Here points are sorted into voxels, and
where those of each frame by itself lie on something flat enough to have a side, the frames are tied
to a common quadric over it. Its coefficients are eliminated in closed form, as the heights of the
map are.

Which way a patch faces is read from the scatter *within* frames: misaligned poses do not blur it.
Every point counts by how far it lies off the surface (Geman & McClure 1987), so that a voxel may
hold edges and strays. Planes in voxels are those of BALM (Liu & Zhang 2021), less the curvature and
the robust loss.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import patch_kernels
from depthba.optimiser.asking import look
from depthba.optimiser.problem import Problem
from depthba.optimiser.workers import SHARES, Workers

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Fewest points of a frame in a patch, and fewest frames.
FEWEST, SEVERAL = 6, 2
# The second axis of a patch is at least this many times its thickness, and this share of the voxel.
FLAT, WIDE = 2.0, 0.1
# Least scale of the loss, in standard deviations of the noise times its factor.
LEAST = 0.3
# A patch whose normal is closer to the map's z axis (cosine) says what the map says better.
LEVEL = 0.9
# How far a point is walked to its surface at most, in sides of its voxel.
REACH = 0.5
# Voxels of the box around all points, per point, above which they are sorted and not counted.
SPARSE = 8.0
# Points of which a median is taken: more say the same.
ENOUGH = 200_000
# Rounds of reweighting in a fit that starts near, and in one that starts from nothing.
NEAR, AFRESH = 2, 4


@dataclass(frozen=True)
class Patches:
    """Surfaces seen by several frames. Points are sorted by patch, and by frame within a patch.

    A *view* is a frame's points in a patch.
    """

    points: Array
    """(n, 3), sensor frame, m."""
    weights: Array
    """(n,), inverse variance relative to the typical one."""
    source: Ints
    """(n,), index of each point among those of its frame."""
    ends: Ints
    """(m + 1,), where the points of each view begin and end."""
    frame: Ints
    """(m,), the frame of each view."""
    views: Ints
    """(k + 1,), where the views of each patch begin and end."""
    axes: Array
    """(k, 3, 3), columns: normal and two directions along the patch; a rotation."""
    centre: Array
    """(k, 3), map frame, m: where the surface is expanded."""
    reach: Array
    """(k,), m, how far a point is walked to its surface at most."""
    stiff: Array
    """(k,), m^4, what a squared second-order coefficient costs."""
    surface: Array
    """(k, 6), coefficients of the surfaces at the poses where they were fitted last."""
    robust: float
    """Scale of the robust loss in robust standard deviations of the residuals."""
    scale: float
    """The same in m; 0: no such loss."""
    rays: bool
    """Whether points lie on rays from the origin of their sensor."""
    frames: int
    """N, all frames of the problem."""

    def __len__(self) -> int:
        return len(self.centre)

    @property
    def deviation(self) -> float:
        """Robust standard deviation of the residuals that the loss goes by, m."""
        return self.scale / self.robust

    def fitted(self, T_map_camera: Array, workers: Workers, rounds: int = NEAR) -> Fit:
        """Return the surfaces that fit best at poses (N, 4, 4), and what they cost."""
        Q, o = self._local(T_map_camera)
        surface, off = self.surface.copy(), np.empty(len(self.points))

        def of(share: tuple[int, int]) -> float:
            return float(
                patch_kernels.fit(
                    *share, self.points, self.weights, self.ends, self.views, Q, o, self.reach,
                    self.stiff, self.rays, self.scale**2, rounds, surface, off,
                )
            )  # fmt: skip

        cost = float(sum(workers.map(of, self._shares())))
        return Fit(replace(self, surface=surface), cost, off)

    def only(self, these: NDArray[np.bool_]) -> Patches:
        """Return some of the patches, (k,)."""
        views = np.repeat(these, np.diff(self.views))
        points = np.repeat(views, np.diff(self.ends))
        return replace(
            self,
            points=self.points[points],
            weights=self.weights[points],
            source=self.source[points],
            ends=np.concatenate([[0], np.cumsum(np.diff(self.ends)[views])]),
            frame=self.frame[views],
            views=np.concatenate([[0], np.cumsum(np.diff(self.views)[these])]),
            axes=self.axes[these],
            centre=self.centre[these],
            reach=self.reach[these],
            stiff=self.stiff[these],
            surface=self.surface[these],
        )

    def normal_equations(
        self, T_map_camera: Array, pivots: Array, workers: Workers
    ) -> tuple[Array, Array]:
        """Return the matrix (6N, 6N) and gradient (N, 6) in perturbations about the pivots (N, 3).

        The surfaces, fitted at these poses or near them, are eliminated.
        """
        n = self.frames
        Q, o = self._local(T_map_camera)
        pivot = self._in_patches(pivots)

        def of(share: tuple[int, int]) -> tuple[Array, Array]:
            A, g = np.zeros((n, 6, n, 6)), np.zeros((n, 6))
            patch_kernels.gather(
                *share, self.points, self.weights, self.ends, self.views, self.frame, Q, o, pivot,
                self.axes, self.reach, self.stiff, self.rays, self.surface, self.scale**2, A, g,
            )  # fmt: skip
            return A, g

        A, g = np.zeros((n, 6, n, 6)), np.zeros((n, 6))
        for more, pull in workers.map(of, self._shares()):
            A += more
            g += pull
        whole = A.reshape(6 * n, 6 * n)
        return np.tril(whole) + np.tril(whole, -1).T, g

    def scores(
        self, T_map_camera: Array, pivots: Array, groups: list[NDArray[np.uint8]], count: int,
        workers: Workers,
    ) -> Array:  # fmt: skip
        """Return the reduced gradient of each group of points, (kinds, count, 6N).

        ``groups`` says for each frame, (kinds, points of the frame), which group a point is in.
        """
        n, kinds = self.frames, len(groups[0])
        Q, o = self._local(T_map_camera)
        pivot, mine = self._in_patches(pivots), np.empty((len(self.points), kinds), np.uint8)
        for m, (first, last) in enumerate(pairwise(self.ends)):
            mine[first:last] = groups[self.frame[m]][:, self.source[first:last]].T

        def of(share: tuple[int, int]) -> Array:
            out = np.zeros((kinds, count, n, 6))
            patch_kernels.scores(
                *share, self.points, self.weights, self.ends, self.views, self.frame, Q, o, pivot,
                self.axes, self.reach, self.stiff, self.rays, self.surface, self.scale**2, mine,
                out,
            )  # fmt: skip
            return out

        total = sum(workers.map(of, self._shares()), start=np.zeros((kinds, count, n, 6)))
        return np.asarray(total.reshape(kinds, count, 6 * n))

    def _local(self, T: Array) -> tuple[Array, Array]:
        """Return Q (m, 3, 3) and o (m, 3): a point p of a view lies at ``Q p + o`` in its patch."""
        Q, o = np.empty((len(self.frame), 3, 3)), np.empty((len(self.frame), 3))
        patch_kernels.local(self.frame, self.views, self.axes, self.centre, T, Q, o)
        return Q, o

    def _in_patches(self, pivots: Array) -> Array:
        """Return (m, 3) the pivot of each view's frame in the axes of its patch."""
        patch = np.repeat(np.arange(len(self)), np.diff(self.views))
        away = pivots[self.frame] - self.centre[patch]
        return np.ascontiguousarray(np.einsum("mji,mj->mi", self.axes[patch], away))

    def _shares(self) -> list[tuple[int, int]]:
        """Deal the patches out in runs, as many whatever the number of threads."""
        ends = np.linspace(0, len(self), SHARES + 1).astype(int).tolist()
        return [(a, b) for a, b in pairwise(ends) if a < b]


@dataclass(frozen=True)
class Fit:
    """Patches whose surfaces were fitted at some poses."""

    patches: Patches
    cost: float
    """Robust sum of squared distances from the surfaces, m^2."""
    off: Array
    """(n,) how far every point lies off its surface, m at a point of typical noise."""

    def true(self, most: float) -> Patches:
        """Return the steep patches whose points lie on their surface but for noise.

        ``most``: median distance from the surface of the points of a patch, m.
        """
        patches, median = self.patches, np.empty(len(self.patches))
        patch_kernels.medians(patches.ends[patches.views], self.off, median)
        level = np.abs(patches.axes[:, 2, 0]) > LEVEL
        return patches.only((median <= most) & ~level)

    def rescaled(self, sigma: float) -> Fit:
        """Return the patches with the loss that their residuals call for; it never widens.

        ``sigma``: standard deviation of the points' noise, m, which keeps the scale from vanishing.
        """
        if not len(self.patches):
            return self
        patches, squares = self.patches, np.square(self.off)
        some = squares[:: -(-len(squares) // ENOUGH)]
        scale = patches.robust * max(1.4826 * float(np.sqrt(np.median(some))), LEAST * sigma)
        scale = min(scale, patches.scale or scale)
        cost = scale**2 * float((squares / (scale**2 + squares)).sum())
        cost += float((patches.stiff[:, None] * patches.surface[:, 3:] ** 2).sum())
        return Fit(replace(patches, scale=scale), cost, self.off)


@dataclass(frozen=True)
class Cloud:
    """Points of all frames, some of which may lie on patches."""

    points: Array
    """(n, 3), sensor frame, m."""
    weights: Array
    """(n,), inverse variance relative to the typical one."""
    frame: Ints
    """(n,)."""
    source: Ints
    """(n,), index of each point among those of its frame."""
    rays: bool
    """Whether points lie on rays from the origin of their sensor."""

    @staticmethod
    def of(problem: Problem) -> Cloud:
        """Return all points of a problem."""
        parts = [f.points for f in problem.frames]
        return Cloud(
            np.concatenate([p[:, :3] for p in parts]).astype(np.float64),
            np.concatenate([p[:, 3] for p in parts]).astype(np.float64) ** 2,
            np.repeat(np.arange(len(parts)), [len(p) for p in parts]),
            np.concatenate([np.arange(len(p)) for p in parts]),
            problem.origin,
        )

    def weighed(self, factor: Array) -> Cloud:
        """Return the points with their weights times a factor (n,), without those of none."""
        k = factor > 0
        return replace(
            self,
            points=self.points[k],
            weights=factor[k] * self.weights[k],
            frame=self.frame[k],
            source=self.source[k],
        )


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
    x = np.empty_like(cloud.points)
    patch_kernels.to_map(cloud.points, cloud.frame, T_map_camera, x)
    left, parts = np.arange(len(x)), []
    for side in sides:
        look()
        parts.append(_voxels(x, cloud, left, side))
        left = parts[-1].left
    order = np.concatenate([p.points for p in parts])
    each = np.repeat(sides, [len(p.centre) for p in parts])
    laid = Patches(
        points=cloud.points[order],
        weights=cloud.weights[order],
        source=cloud.source[order],
        ends=_ends([p.sizes for p in parts]),
        frame=np.concatenate([p.frame for p in parts]),
        views=_ends([p.views for p in parts]),
        axes=np.concatenate([p.axes for p in parts]),
        centre=np.concatenate([p.centre for p in parts]),
        reach=REACH * each,
        stiff=(sigma * each) ** 2,
        surface=np.zeros((len(each), patch_kernels.TERMS)),
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
    frame: Ints
    """(m,), its frame."""
    views: Ints
    """(k,), views of each patch."""
    axes: Array
    """(k, 3, 3)."""
    centre: Array
    """(k, 3)."""
    left: Ints
    """Indices of the points on none, ascending."""


def _voxels(x: Array, cloud: Cloud, these: Ints, side: float) -> _Found:
    """Find patches among some of the points x (n, 3), ascending, in voxels of the given side, m."""
    if not len(these):
        none = np.empty(0, np.int64)
        return _Found(none, none, none, none, np.empty((0, 3, 3)), np.empty((0, 3)), these)
    voxel, k = _voxel_of(x, these, side)
    order = np.empty_like(these)
    patch_kernels.sort_by(voxel, k, order)
    look()
    voxel, order = voxel[order], these[order]
    frame = cloud.frame[order]
    new = (voxel[1:] != voxel[:-1]) | (frame[1:] != frame[:-1])
    begins = np.flatnonzero(np.concatenate([[True], new]))
    voxel, frame = voxel[begins], frame[begins]
    begins = np.append(begins, len(order))
    m = len(frame)
    weight, mean, spread = np.empty(m), np.empty((m, 3)), np.empty((m, 3, 3))
    patch_kernels.moments(order, begins, x, cloud.weights, weight, mean, spread)
    look()
    many = np.diff(begins) >= FEWEST
    several = np.bincount(voxel[many], minlength=k) >= SEVERAL
    many &= several[voxel]
    # from here on of the voxels that several frames see
    on, k = (np.cumsum(several) - 1)[voxel[many]], int(several.sum())
    total, pooled = np.bincount(on, weight[many], k), np.zeros((k, 3, 3))
    np.add.at(pooled, on, spread[many])
    values, axes = np.linalg.eigh(pooled)
    good = (values[:, 1] > FLAT**2 * values[:, 0]) & (values[:, 1] > total * (WIDE * side) ** 2)
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    moment = [np.bincount(on, weight[many] * mean[many, a], k) for a in range(3)]
    centre = np.stack(moment, axis=1) / np.maximum(total, 1e-300)[:, None]
    chosen = np.zeros(m, bool)
    chosen[np.flatnonzero(many)[good[on]]] = True
    sizes = np.diff(begins)
    taken = order[np.repeat(chosen, sizes)]
    rest = np.zeros(len(x), bool)
    rest[these] = True
    rest[taken] = False
    return _Found(
        taken,
        sizes[chosen],
        frame[chosen],
        np.bincount(on, minlength=k)[good],
        axes[good],
        centre[good],
        np.flatnonzero(rest),
    )


def _voxel_of(x: Array, these: Ints, side: float) -> tuple[Ints, int]:
    """Return the voxel of some points, numbered in order without gaps, and how many there are."""
    least, most = np.empty(3, np.int64), np.empty(3, np.int64)
    patch_kernels.extent(x, these, side, least, most)
    key, spans = np.empty_like(these), most - least + 1
    patch_kernels.number(x, these, side, least, spans, key)
    if float(np.prod(spans.astype(float))) > SPARSE * len(key):
        used, numbers = np.unique(key, return_inverse=True)
        return numbers, len(used)
    there = np.bincount(key) > 0
    return (np.cumsum(there) - 1)[key], int(there.sum())
