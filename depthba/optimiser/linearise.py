"""Linearising the problem.

One pass over all points fills the normal equations of poses and map together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import kernels, map_kernels
from depthba.optimiser.asking import look
from depthba.optimiser.deviation import robust_deviation
from depthba.optimiser.grid import Grid
from depthba.optimiser.problem import FramePoints, Problem
from depthba.optimiser.stencil import Stencil
from depthba.optimiser.workers import Workers


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
    memory: NDArray[np.float64] | None = None
    """What ``values`` is laid out in, with some room to spare."""

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

    def uncoupled(self) -> Linearisation:
        """Return the same without B, which takes more memory than all points."""
        return replace(self, B=())


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
    spare: Linearisation | None = None,
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
        spare: a linearisation of the same points on the same grid that nobody reads any more: its
            arrays are overwritten, which saves fetching fresh memory at every step.
    """
    if spare is not None and spare.C.own.shape != grid.shape:
        spare = None
    count = len(problem.frames)
    judge = judge or loss
    pivots = pivots_of(problem, state.T_map_camera)
    fronts = fronts_of(problem, state.T_map_camera)
    A, g = np.zeros((count, 6, 6)), np.zeros((count, 6))
    costs = np.zeros((count, 3))
    if spare is None:
        weights = tuple(np.empty(len(f), np.float32) for f in problem.frames)
        residuals = tuple(np.empty(len(f), np.float32) for f in problem.frames)
    else:
        weights, residuals = spare.weights, spare.residuals
    B = tuple(
        footprint(f, T, grid, loss, None if spare is None else spare.B[i])
        for i, (f, T) in enumerate(zip(problem.frames, state.T_map_camera, strict=True))
    )
    shares = workers.shares(problem)
    scratch = workers.scratch(grid.shape, len(shares))
    bands = workers.bands(grid.shape[0])

    def nodes_of(band: tuple[int, int]) -> None:
        map_kernels.nodal_rows(state.heights, grid.spacing, scratch.nodes, *band)

    def share(frames: range, total: NDArray[np.float64]) -> None:
        total.fill(0.0)
        for i in frames:
            look()
            B[i].values.fill(0.0)
            frame, pose = problem.frames[i], state.T_map_camera[i]
            costs[i] = kernels.accumulate(
                frame.points, frame.inverse_noise, frame.share, pose[:3, :3].copy(),
                pose[:3, 3].copy(), pose[:3, 3] - pivots[i], grid.origin, grid.spacing,
                scratch.nodes, loss.along_ray, loss.slope, fronts[i], loss.cap, loss.robust_c,
                judge.robust_c, judge.charge, weights[i], residuals[i], total,
                A[i], g[i], B[i].values, B[i].x, B[i].y,
            )  # fmt: skip

    workers.map(nodes_of, bands)
    workers.map(share, shares, scratch.totals)
    C = Stencil.empty(grid.shape) if spare is None else spare.C
    g_map = np.empty(grid.shape) if spare is None else spare.g_map
    rough = workers.map(
        lambda band: map_kernels.collect(
            scratch.totals, state.heights, smooth, loss.smoothing, *band,
            C.own, C.right, C.up, C.up_right, C.up_left, g_map,
        ),
        bands,
    )  # fmt: skip
    return Linearisation(
        A, g, B, C, g_map,
        float(costs[:, 0].sum()) + sum(rough), float(costs[:, 1].sum()) + sum(rough),
        int(costs[:, 2].sum()),
        weights, residuals, pivots,
    )  # fmt: skip


def robust_sigma(residuals: tuple[NDArray[np.float32], ...]) -> float:
    """Return 1.4826 times the median absolute residual, m; 0 without any."""
    some = np.concatenate([r[:: max(1, len(r) // 5000)] for r in residuals])
    some = some[np.isfinite(some)]
    return robust_deviation(some) if len(some) else 0.0


def footprint(
    frame: FramePoints,
    T: NDArray[np.float64],
    grid: Grid,
    loss: Loss,
    spare: Footprint | None,
) -> Footprint:
    """Return a footprint with room for all that the frame can touch; its values are not set."""
    q = frame.hull @ T[:2, :3].T + T[:2, 3]
    reach = 2 + int(np.ceil(loss.cap / grid.spacing)) if loss.along_ray else 2
    low = np.floor((q.min(axis=0) - grid.origin) / grid.spacing).astype(int) - reach
    high = np.ceil((q.max(axis=0) - grid.origin) / grid.spacing).astype(int) + reach
    x0, y0 = np.clip(low, 0, [grid.shape[1] - 2, grid.shape[0] - 2])
    x1, y1 = np.clip(high, [x0 + 2, y0 + 2], [grid.shape[1], grid.shape[0]])
    shape = (int(y1 - y0), int(x1 - x0), 6)
    memory = None if spare is None else spare.memory
    if memory is None or memory.size < np.prod(shape):
        # room to grow by a few nodes each way as the pose moves
        memory = np.empty((shape[0] + 8) * (shape[1] + 8) * 6)
    return Footprint(int(y0), int(x0), memory[: int(np.prod(shape))].reshape(shape), memory)
