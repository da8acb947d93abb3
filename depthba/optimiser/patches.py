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

from depthba.optimiser import patch_kernels, patch_points
from depthba.optimiser.deviation import robust_deviation
from depthba.optimiser.workers import SHARES, Workers

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Least scale of the loss, in standard deviations of the noise times its factor.
LEAST = 0.3
# A patch whose normal is closer to the map's z axis (cosine) says what the map says better.
LEVEL = 0.9
# Points of which a median is taken: more say the same.
ENOUGH = 200_000
# Rounds of reweighting in a fit that starts near.
NEAR = 2


@dataclass(frozen=True)
class Patches:
    """Surfaces seen by several frames. Points are sorted by patch, and by frame within a patch.

    A *view* is a frame's points in a patch.
    """

    points: NDArray[np.float32]
    """(n, 3), sensor frame, m."""
    weights: Array
    """(n,), inverse variance relative to the typical one."""
    source: NDArray[np.int32]
    """(n,), index of each point among those of its frame."""
    ends: Ints
    """(m + 1,), where the points of each view begin and end."""
    frame: NDArray[np.int32]
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
        Q, o = self.local(T_map_camera)
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
        Q, o = self.local(T_map_camera)
        pivot = self.in_patches(pivots)

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
        Q, o = self.local(T_map_camera)
        pivot, mine = self.in_patches(pivots), self.grouped(groups)

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

    def grouped(self, groups: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """Return (n, kinds) the groups of the points; ``groups`` as in `scores`."""
        mine = np.empty((len(self.points), len(groups[0])), np.uint8)
        for m, (first, last) in enumerate(pairwise(self.ends)):
            mine[first:last] = groups[self.frame[m]][:, self.source[first:last]].T
        return mine

    def local(self, T: Array) -> tuple[Array, Array]:
        """Return Q (m, 3, 3) and o (m, 3): a point p of a view lies at ``Q p + o`` in its patch."""
        Q, o = np.empty((len(self.frame), 3, 3)), np.empty((len(self.frame), 3))
        patch_points.local(self.frame, self.views, self.axes, self.centre, T, Q, o)
        return Q, o

    def in_patches(self, pivots: Array) -> Array:
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

    def true(self, most: float, workers: Workers) -> Patches:
        """Return the steep patches whose points lie on their surface but for noise.

        ``most``: median distance from the surface of the points of a patch, m.
        """
        patches = self.patches
        steep = np.flatnonzero(np.abs(patches.axes[:, 2, 0]) <= LEVEL)
        median = np.empty(len(steep))
        ends = patches.ends[patches.views]
        workers.over(len(steep), patch_kernels.medians, steep, ends, self.off, median)
        chosen = np.zeros(len(patches), bool)
        chosen[steep[median <= most]] = True
        return patches.only(chosen)

    def counted(self, times: float) -> Fit:
        """Return the same, with all that the patches say said so many times."""
        root, p = float(np.sqrt(times)), self.patches
        patches = replace(p, weights=times * p.weights, stiff=times * p.stiff, scale=root * p.scale)
        return Fit(patches, times * self.cost, root * self.off)

    def rescaled(self, sigma: float) -> Fit:
        """Return the patches with the loss that their residuals call for; it never widens.

        ``sigma``: standard deviation of the points' noise, m, which keeps the scale from vanishing.
        """
        if not len(self.patches):
            return self
        patches = self.patches
        shown = robust_deviation(self.off[:: -(-len(self.off) // ENOUGH)])
        scale = patches.robust * max(shown, LEAST * sigma)
        scale = min(scale, patches.scale or scale)
        cost = patch_kernels.charge_of(self.off, scale**2)
        cost += float((patches.stiff[:, None] * patches.surface[:, 3:] ** 2).sum())
        return Fit(replace(patches, scale=scale), cost, self.off)
