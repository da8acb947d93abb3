"""Linearising the problem.

One pass over all points fills the normal equations of poses and map together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import kernels
from depthba.optimiser.grid import Grid
from depthba.optimiser.problem import FramePoints, Problem
from depthba.optimiser.stencil import Stencil

T = TypeVar("T")


@dataclass(frozen=True)
class Loss:
    """How a residual is taken and weighed."""

    along_ray: bool
    """Walk along the viewing ray to the map; else the vertical distance."""
    slope: bool
    """Weigh a vertical residual by 1 / (1 + slope^2)."""
    robust_c: float
    """Scale of the Geman-McClure loss, m; 0 switches it off."""
    cap: float
    """Longest walk along a ray, m."""
    charge: float
    """What a point costs that is not on the map, m^2."""
    smoothing: float
    """Weight of a squared height difference between neighbouring nodes."""


@dataclass(frozen=True)
class State:
    """What is estimated: poses and heights."""

    T_map_camera: NDArray[np.float64]
    heights: NDArray[np.float64]


@dataclass(frozen=True)
class Footprint:
    """A frame's coupling with the map: ``values`` (h, w, 6) over the nodes from (y, x) on."""

    y: int
    x: int
    values: NDArray[np.float64]

    @property
    def window(self) -> tuple[slice, slice]:
        """The nodes that it covers."""
        h, w = self.values.shape[:2]
        return slice(self.y, self.y + h), slice(self.x, self.x + w)


@dataclass(frozen=True)
class Linearisation:
    """Normal equations at a state, ``[A B; B^T C] [pose; map] = -[g_pose; g_map]``.

    With them goes what the points said there.
    """

    A: NDArray[np.float64]
    """(N, 6, 6)."""
    g_pose: NDArray[np.float64]
    """(N, 6)."""
    B: tuple[Footprint, ...]
    C: Stencil
    g_map: NDArray[np.float64]
    """(ny, nx)."""
    cost: float
    """At the loss's own scale, smoothing included, m^2."""
    judged: float
    """At the scale to compare with, smoothing included, m^2."""
    used: int
    """Points on the map."""
    weights: tuple[NDArray[np.float32], ...]
    """Robust weight of every point; 0 off the map."""
    residuals: tuple[NDArray[np.float32], ...]
    """Normalised residual of every point, m; NaN off the map."""
    pivots: NDArray[np.float64]
    """(N, 3), map frame, about which the poses are perturbed."""


class Workers:
    """A few threads over which frames are dealt out.

    Sums are formed in a fixed order, whatever finishes first.
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def map(self, function: Callable[..., T], *items: Iterable[Any]) -> list[T]:
        """Return the results in the order of the items."""
        if self._pool is None:
            return list(map(function, *items))
        return list(self._pool.map(function, *items))

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)

    def shares(self, problem: Problem) -> list[range]:
        """Deal the frames out in runs of about equal numbers of points."""
        sizes = np.array([len(f) for f in problem.frames], dtype=float)
        ends = np.cumsum(sizes) - sizes / 2
        share = np.minimum(
            (ends / max(sizes.sum(), 1) * self.threads).astype(int), self.threads - 1
        )
        return [
            range(int(np.flatnonzero(share == k)[0]), int(np.flatnonzero(share == k)[-1]) + 1)
            for k in range(self.threads)
            if (share == k).any()
        ]


def pivots_of(problem: Problem, T_map_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each frame's centroid in the map frame, (N, 3)."""
    return np.stack(
        [
            T[:3, :3] @ f.centroid + T[:3, 3]
            for f, T in zip(problem.frames, T_map_camera, strict=True)
        ]
    )


def fronts_of(problem: Problem, T_map_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N,) the sign of n.u for a surface that faces the sensor.

    -1 where it looks down on the map.
    """
    down = [T[2, :3] @ f.centroid for f, T in zip(problem.frames, T_map_camera, strict=True)]
    return np.where(np.array(down) > 0, 1.0, -1.0)


def linearise(
    problem: Problem,
    grid: Grid,
    state: State,
    loss: Loss,
    workers: Workers,
    smooth: NDArray[np.bool_],
    judge: Loss | None = None,
) -> Linearisation:
    """Fill the normal equations at ``state``.

    Args:
        problem: the points.
        grid: where the nodes stand.
        state: poses and heights.
        loss: the residual and its weight.
        workers: the threads.
        smooth: (ny, nx) nodes that the smoothing term ties to their neighbours.
        judge: the loss of the linearisation to compare the cost with; None: the same.
    """
    nodes = np.empty((*grid.shape, 3))
    kernels.nodal_gradients(state.heights, grid.spacing, nodes)
    pivots = pivots_of(problem, state.T_map_camera)
    fronts = fronts_of(problem, state.T_map_camera)
    count = len(problem.frames)
    A, g = np.zeros((count, 6, 6)), np.zeros((count, 6))
    costs = np.zeros((count, 3))
    weights = tuple(np.empty(len(f), np.float32) for f in problem.frames)
    residuals = tuple(np.empty(len(f), np.float32) for f in problem.frames)
    judge = judge or loss
    B: list[Footprint] = [
        _empty_footprint(f, T, grid, loss)
        for f, T in zip(problem.frames, state.T_map_camera, strict=True)
    ]

    def share(frames: range) -> NDArray[np.float64]:
        total = np.zeros((*grid.shape, 6))
        for i in frames:
            pose = state.T_map_camera[i]
            costs[i] = kernels.accumulate(
                problem.frames[i].points, pose[:3, :3].copy(), pose[:3, 3].copy(),
                pose[:3, 3] - pivots[i], grid.origin, grid.spacing, nodes,
                loss.along_ray, loss.slope, fronts[i], loss.cap, loss.robust_c, judge.robust_c,
                judge.charge, weights[i], residuals[i], total,
                A[i], g[i], B[i].values, B[i].x, B[i].y,
            )  # fmt: skip
        return total

    totals = workers.map(share, workers.shares(problem))
    stencil = totals[0]
    for other in totals[1:]:
        stencil += other
    A += np.tril(A, -1).transpose(0, 2, 1)
    C = Stencil(*(np.ascontiguousarray(stencil[..., k]) for k in range(5)))
    g_map = np.ascontiguousarray(stencil[..., 5])
    smoothing = _add_smoothing(C, g_map, state.heights, loss.smoothing, smooth)
    # nodes that nothing touches stay what they are
    C.own[C.own <= 0.0] = 1.0
    return Linearisation(
        A, g, tuple(B), C, g_map,
        float(costs[:, 0].sum()) + smoothing, float(costs[:, 1].sum()) + smoothing,
        int(costs[:, 2].sum()),
        weights, residuals, pivots,
    )  # fmt: skip


def robust_sigma(residuals: tuple[NDArray[np.float32], ...]) -> float:
    """Return 1.4826 times the median absolute residual, m; 0 without any."""
    some = np.concatenate([r[:: max(1, len(r) // 5000)] for r in residuals])
    some = some[np.isfinite(some)]
    return float(1.4826 * np.median(np.abs(some))) if len(some) else 0.0


def _empty_footprint(
    frame: FramePoints, T: NDArray[np.float64], grid: Grid, loss: Loss
) -> Footprint:
    q = frame.hull @ T[:2, :3].T + T[:2, 3]
    reach = 2 + int(np.ceil(loss.cap / grid.spacing)) if loss.along_ray else 2
    low = np.floor((q.min(axis=0) - grid.origin) / grid.spacing).astype(int) - reach
    high = np.ceil((q.max(axis=0) - grid.origin) / grid.spacing).astype(int) + reach
    x0, y0 = np.clip(low, 0, [grid.shape[1] - 2, grid.shape[0] - 2])
    x1, y1 = np.clip(high, [x0 + 2, y0 + 2], [grid.shape[1], grid.shape[0]])
    return Footprint(int(y0), int(x0), np.zeros((y1 - y0, x1 - x0, 6)))


def _add_smoothing(
    C: Stencil,
    g: NDArray[np.float64],
    heights: NDArray[np.float64],
    weight: float,
    smooth: NDArray[np.bool_],
) -> float:
    """Add ``weight * (difference of neighbouring heights)^2`` to the map's block.

    Return that cost.
    """
    along_x = weight * (smooth[:, :-1] & smooth[:, 1:])
    along_y = weight * (smooth[:-1] & smooth[1:])
    dx, dy = np.diff(heights, axis=1), np.diff(heights, axis=0)
    C.own[:, 1:] += along_x
    C.own[:, :-1] += along_x
    C.own[1:] += along_y
    C.own[:-1] += along_y
    C.right[:, :-1] -= along_x
    C.up[:-1] -= along_y
    g[:, 1:] += along_x * dx
    g[:, :-1] -= along_x * dx
    g[1:] += along_y * dy
    g[:-1] -= along_y * dy
    return float((along_x * dx**2).sum() + (along_y * dy**2).sum())
