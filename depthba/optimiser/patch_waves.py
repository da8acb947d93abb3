"""What patches say of the camera's fixed pattern, as `pattern` has it from the map.

A pattern moves the points of a patch along their rays: by the cosine between ray and normal off the
surface. The surfaces are eliminated as they are from the poses.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from depthba.compiling import inlined, kernel, part
from depthba.optimiser.patch_points import (
    COUNTS,
    OFF,
    RAY_0,
    RAY_1,
    RAY_2,
    SLOPE_U,
    SLOPE_V,
    backward,
    by_pose,
    by_surface,
    firm,
    forward,
    into_map,
    meet,
    place,
    room,
    spot,
    surface_sums,
    weigh,
)
from depthba.optimiser.patches import Patches
from depthba.optimiser.waves import Waves
from depthba.optimiser.workers import Workers

Array = NDArray[np.float64]

# Points whose waves are held at once.
AT_ONCE = 100_000


@dataclass(frozen=True)
class Told:
    """What patches add to the normal equations of the pattern, their surfaces eliminated."""

    own: Array
    """(m, m), block of the pattern itself."""
    cross: Array
    """(6N, m), coupling with the poses."""
    gradient: Array
    """(m,)."""
    surfaces: Array
    """(k, 6, m), by how much each surface moves with a unit of each wave."""


def told(
    patches: Patches, T_map_camera: Array, pivots: Array, waves: Waves, workers: Workers
) -> Told:
    """Return what patches, fitted at poses (N, 4, 4), say of the pattern; pivots (N, 3)."""
    m, n = len(waves), patches.frames
    Q, o, pivot = *patches.local(T_map_camera), patches.in_patches(pivots)
    surfaces = np.zeros((len(patches), 6, m))

    def of(run: tuple[int, int]) -> tuple[Array, Array, Array]:
        own, cross, gradient = np.zeros((m, m)), np.zeros((n, 6, m)), np.zeros(m)
        _gather(
            *run, patches.points, patches.weights, patches.ends, patches.views, patches.frame, Q,
            o, pivot, patches.axes, patches.reach, patches.stiff, patches.rays, patches.surface,
            patches.scale**2, _waves(patches, waves, run), own, cross, gradient, surfaces,
        )  # fmt: skip
        return own, cross, gradient

    own, cross, gradient = np.zeros((m, m)), np.zeros((n, 6, m)), np.zeros(m)
    for more, between, pull in workers.map(of, _runs(patches)):
        own += more
        cross += between
        gradient += pull
    return Told(np.tril(own) + np.tril(own, -1).T, cross.reshape(6 * n, m), gradient, surfaces)


def scores(
    patches: Patches, T_map_camera: Array, waves: Waves, surfaces: Array,
    groups: list[NDArray[np.uint8]], count: int, workers: Workers,
) -> Array:  # fmt: skip
    """Return the pattern's reduced gradient of each group of points, (kinds, count, m).

    ``surfaces`` (k, 6, m) are those of `Told`; ``groups`` as in `Patches.scores`.
    """
    m, kinds = len(waves), len(groups[0])
    Q, o = patches.local(T_map_camera)
    mine = patches.grouped(groups)

    def of(run: tuple[int, int]) -> Array:
        out = np.zeros((kinds, count, m))
        _score(
            *run, patches.points, patches.weights, patches.ends, patches.views, Q, o,
            patches.reach, patches.rays, patches.surface, patches.scale**2,
            _waves(patches, waves, run), surfaces, mine, out,
        )  # fmt: skip
        return out

    return np.asarray(sum(workers.map(of, _runs(patches)), start=np.zeros((kinds, count, m))))


def _runs(patches: Patches) -> list[tuple[int, int]]:
    """Deal the patches out in runs of so few points that their waves can be held."""
    count = max(1, -(-len(patches.points) // AT_ONCE))
    ends = np.linspace(0, len(patches), count + 1).astype(int).tolist()
    return [(a, b) for a, b in pairwise(ends) if a < b]


def _waves(patches: Patches, waves: Waves, run: tuple[int, int]) -> NDArray[np.float32]:
    """Return the waves (n, m) at the points of a run of patches."""
    first, last = patches.ends[patches.views[list(run)]]
    return waves.at(patches.points[first:last])


@inlined
def _cosine(at, s):
    """Return the change of a point's distance from the surface with its range."""
    return s[RAY_0 + at] + s[SLOPE_U + at] * s[RAY_1 + at] + s[SLOPE_V + at] * s[RAY_2 + at]


@kernel
def _gather(
    first, last, points, weights, ends, views, frame, Q, o, pivot, axes, reach, stiff, rays,
    surface, square, waves, own, cross, gradient, surfaces,
):  # fmt: skip
    """Add what some patches say to ``own`` (m, m), lower triangle, ``cross`` and ``gradient``."""
    s, m = room(first, last, ends, views), len(gradient)
    b, M, L, W = np.zeros(6), np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, m))
    start = ends[views[first]]
    for k in range(first, last):
        n = place(k, points, weights, ends, views, Q, o, rays, s)
        meet(n, surface[k], rays, reach[k], s)
        weigh(n, square, s)
        surface_sums(n, s, M, b)
        for j in range(3, 6):
            b[j] -= stiff[k] * surface[k, j]
        firm(M, stiff[k], L)
        begin = ends[views[k]]
        here = waves[begin - start : begin - start + n]
        _sum(n, s, here, own, gradient, W)
        _eliminate(L, W, b, surfaces[k], own, gradient)
        for view in range(views[k], views[k + 1]):
            i, j = ends[view] - begin, ends[view + 1] - begin
            _couple(i, j, s, here, pivot[view], axes[k], surfaces[k], cross[frame[view]])


@part
def _sum(n, s, waves, own, gradient, W):
    """Add a patch's points to ``own`` and ``gradient``; W (6, m) gets surface against pattern."""
    phi, m = np.zeros(6), len(gradient)
    W[:] = 0.0
    for i in range(n):
        at, wave = spot(i), waves[i]
        by_surface(phi, at, s)
        c = _cosine(at, s)
        pull = s[COUNTS + at] * c
        e = pull * s[OFF + at]
        for j in range(m):
            gradient[j] -= e * wave[j]
            t = pull * c * wave[j]
            for other in range(j + 1):
                own[j, other] += t * wave[other]
        for a in range(6):
            t = pull * phi[a]
            for j in range(m):
                W[a, j] += t * wave[j]


@part
def _eliminate(L, W, b, X, own, gradient):
    """Take the surface out, whose factor is L and gradient b; X (6, m) gets how it follows."""
    m = len(gradient)
    for j in range(m):
        x = W[:, j].copy()
        forward(L, x)
        backward(L, x)
        X[:, j] = x
    for j in range(m):
        for a in range(6):
            gradient[j] += X[a, j] * b[a]
        for other in range(j + 1):
            t = 0.0
            for a in range(6):
                t += W[a, j] * X[a, other]
            own[j, other] -= t


@part
def _couple(first, last, s, waves, pivot, V, X, cross):
    """Add what a view's points say of its pose and the pattern at once to ``cross`` (6, m)."""
    phi, J, row, P = np.zeros(6), np.zeros(6), np.zeros((1, 6)), np.zeros((6, 6))
    m = waves.shape[1]
    for i in range(first, last):
        at = spot(i)
        by_pose(J, at, s, pivot)
        by_surface(phi, at, s)
        into_map(J.reshape(1, 6), V, row)
        w = s[COUNTS + at]
        pull = w * _cosine(at, s)
        for a in range(6):
            t = pull * row[0, a]
            for j in range(m):
                cross[a, j] -= t * waves[i, j]
            for j in range(6):
                P[a, j] += w * row[0, a] * phi[j]
    for a in range(6):
        for j in range(m):
            t = 0.0
            for k in range(6):
                t += P[a, k] * X[k, j]
            cross[a, j] += t


@kernel
def _score(
    first, last, points, weights, ends, views, Q, o, reach, rays, surface, square, waves,
    surfaces, groups, out,
):  # fmt: skip
    """Add the pattern's reduced gradient of each group of points to ``out`` (kinds, groups, m)."""
    s, m = room(first, last, ends, views), out.shape[2]
    phi, v = np.zeros(6), np.zeros(m)
    start = ends[views[first]]
    for k in range(first, last):
        n = place(k, points, weights, ends, views, Q, o, rays, s)
        meet(n, surface[k], rays, reach[k], s)
        weigh(n, square, s)
        begin = ends[views[k]]
        for i in range(n):
            at = spot(i)
            by_surface(phi, at, s)
            c = _cosine(at, s)
            wr = s[COUNTS + at] * s[OFF + at]
            for j in range(m):
                t = -c * waves[begin - start + i, j]
                for a in range(6):
                    t += phi[a] * surfaces[k, a, j]
                v[j] = wr * t
            for kind in range(groups.shape[1]):
                to = out[kind, groups[begin + i, kind]]
                for j in range(m):
                    to[j] += v[j]
