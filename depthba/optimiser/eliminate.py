"""Eliminating the map: from the joint normal equations to the poses alone, and back.

The reduced matrix is ``S = A - B C^-1 B^T`` over the free frames. Two roads lead to a step:

- *direct*: :func:`reduce` solves with C for every column of B, each over the window that it
  reaches, and S is formed and factored. On small maps that costs less than the pass.
- *iterative*: conjugate gradients on the exact S, each product of which is one solve with C,
  preconditioned by an S from earlier in the level, or by the *lumped* bound, which replaces C by
  the diagonal of its absolute row sums.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
import scipy.sparse.linalg
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from depthba.optimiser.linearise import Footprint, Linearisation
from depthba.optimiser.stencil import MapSolver
from depthba.optimiser.workers import Workers

# Nodes beyond a footprint after which the map's answer to it has died away: where there are data it
# falls by about four from one node to the next.
REACH = 12
# Nodes in the windows of all frames, per point, up to which the direct road is the shorter one.
DIRECT = 0.15


@dataclass(frozen=True)
class Step:
    """A step of poses and map."""

    pose: NDArray[np.float64]
    """(N, 6), translation then rotation about the pivots; 0 for frames that are not free."""
    map: NDArray[np.float64]
    """(ny, nx)."""
    decrement: float
    """``pose^T S pose`` with the undamped reduced matrix: the step's length in its own uncertainty,
    squared, times the residual variance."""


@nb.njit(cache=True, nogil=True)
def _lumped_block(B, bx, by, E, ex, ey, bound, out):
    """Add ``B diag(bound)^-1 E^T`` over the nodes that both footprints cover to ``out`` (6, 6)."""
    y0, y1 = max(by, ey), min(by + B.shape[0], ey + E.shape[0])
    x0, x1 = max(bx, ex), min(bx + B.shape[1], ex + E.shape[1])
    for y in range(y0, y1):
        for x in range(x0, x1):
            left, right = B[y - by, x - bx], E[y - ey, x - ex]
            w = 1.0 / bound[y, x]
            for m in range(6):
                v = left[m] * w
                if v != 0.0:
                    for k in range(6):
                        out[m, k] += v * right[k]


@nb.njit(cache=True, nogil=True)
def _product(B, bx, by, E, ex, ey, out):
    """Add ``B E^T`` over the nodes that both windows cover to ``out`` (6, 6)."""
    y0, y1 = max(by, ey), min(by + B.shape[0], ey + E.shape[0])
    x0, x1 = max(bx, ex), min(bx + B.shape[1], ex + E.shape[1])
    for y in range(y0, y1):
        for x in range(x0, x1):
            left, right = B[y - by, x - bx], E[y - ey, x - ex]
            for m in range(6):
                v = np.float64(left[m])
                for k in range(6):
                    out[m, k] += v * right[k]


@nb.njit(cache=True, nogil=True)
def _spread(values, x0, y0, v, out, first, last):
    """Add ``B^T v`` of one frame to the rows ``first`` to ``last`` of the field ``out``."""
    for y in range(max(first - y0, 0), min(last - y0, values.shape[0])):
        for x in range(values.shape[1]):
            b = values[y, x]
            out[y + y0, x + x0] += (
                b[0] * v[0] + b[1] * v[1] + b[2] * v[2] + b[3] * v[3] + b[4] * v[4] + b[5] * v[5]
            )


@nb.njit(cache=True, nogil=True)
def _gather(values, x0, y0, field, out):
    """Add ``B field`` of one frame to ``out`` (6,)."""
    for y in range(values.shape[0]):
        for x in range(values.shape[1]):
            f = field[y + y0, x + x0]
            b = values[y, x]
            for m in range(6):
                out[m] += b[m] * f


def spread(
    lin: Linearisation, pose: NDArray[np.float64], workers: Workers | None = None
) -> NDArray[np.float64]:
    """Return ``B^T pose``, (ny, nx), for pose (N, 6)."""
    field = np.zeros_like(lin.g_map)
    _spread_all(lin.B, pose, field, workers)
    return field


def _spread_all(
    footprints: tuple[Footprint, ...],
    pose: NDArray[np.float64],
    field: NDArray[np.float64],
    workers: Workers | None,
) -> None:
    """Add every frame's values times its part of ``pose`` to the field, band by band of rows."""

    def rows(band: tuple[int, int]) -> None:
        for foot, v in zip(footprints, pose, strict=True):
            if v.any():
                _spread(foot.values, foot.x, foot.y, v, field, *band)

    if workers is None:
        rows((0, len(field)))
    else:
        workers.map(rows, workers.bands(len(field)))


def gather(
    lin: Linearisation, field: NDArray[np.float64], workers: Workers | None = None
) -> NDArray[np.float64]:
    """Return ``B field``, (N, 6)."""
    return gathered(lin.B, field, workers)


def gathered(
    footprints: tuple[Footprint, ...], field: NDArray[np.float64], workers: Workers | None = None
) -> NDArray[np.float64]:
    """Return for each frame the sum over the nodes of its values times the field, (N, 6)."""
    out = np.zeros((len(footprints), 6))

    def one(foot: Footprint, total: NDArray[np.float64]) -> None:
        _gather(foot.values, foot.x, foot.y, field, total)

    if workers is None:
        for foot, total in zip(footprints, out, strict=True):
            one(foot, total)
    else:
        workers.map(one, footprints, out)
    return out


def lumped(lin: Linearisation, workers: Workers) -> NDArray[np.float64]:
    """Return the lumped reduced matrix of all frames, (6N, 6N).

    It bounds the exact one from above.
    """
    n = len(lin.B)
    bound = lin.C.row_sums()
    S = np.zeros((n, 6, n, 6))
    pairs = [(i, j) for i in range(n) for j in range(i, n) if meet(lin.B[i], lin.B[j])]

    def block(pair: tuple[int, int]) -> NDArray[np.float64]:
        one, other = lin.B[pair[0]], lin.B[pair[1]]
        out = np.zeros((6, 6))
        _lumped_block(one.values, one.x, one.y, other.values, other.x, other.y, bound, out)
        return out

    for (i, j), value in zip(pairs, workers.map(block, pairs), strict=True):
        S[i, :, j] -= value
        if i != j:
            S[j, :, i] -= value.T
    for i in range(n):
        S[i, :, i] += lin.A[i]
    return S.reshape(6 * n, 6 * n)


@dataclass(frozen=True)
class Reduction:
    """The map eliminated at one linearisation."""

    S: NDArray[np.float64]
    """(6N, 6N), the exact reduced matrix of all frames."""
    answers: tuple[Footprint, ...]
    """``C^-1 B^T`` of each frame, (h, w, 6) single precision over the window where it matters."""


def windows(lin: Linearisation) -> list[tuple[slice, slice]]:
    """Return for each frame the nodes that its columns of B can move."""
    ny, nx = lin.g_map.shape
    return [
        (
            slice(max(f.y - REACH, 0), min(f.y + f.values.shape[0] + REACH, ny)),
            slice(max(f.x - REACH, 0), min(f.x + f.values.shape[1] + REACH, nx)),
        )
        for f in lin.B
    ]


def direct_is_shorter(lin: Linearisation) -> bool:
    """Whether forming S costs less than a few products with it, judged by the sizes alone."""
    nodes = sum((y.stop - y.start) * (x.stop - x.start) for y, x in windows(lin))
    return bool(nodes < DIRECT * sum(map(len, lin.weights)))


def reduce(
    lin: Linearisation,
    workers: Workers,
    tolerance: float = 1e-3,
    free: NDArray[np.bool_] | None = None,
) -> Reduction:
    """Eliminate the map exactly: one solve with C for each of the 6N columns of B.

    Frames that are not ``free`` (N,) are left out: their rows say nothing.

    With X the solutions and R what they leave of B, ``B C^-1 B^T`` is ``X B^T + R X^T`` but for
    ``R C^-1 R^T``: an error of second order, so a tolerance of 1e-3 leaves 1e-6.
    """
    n = len(lin.B)
    solver = MapSolver(lin.C, tolerance)
    spans = windows(lin)
    stored = np.float32 if tolerance >= 1e-5 else np.float64

    def columns(i: int) -> tuple[Footprint, Footprint]:
        foot, (ys, xs) = lin.B[i], spans[i]
        shape = ys.stop - ys.start, xs.stop - xs.start
        X, R = np.zeros((*shape, 6), stored), np.zeros((*shape, 6), stored)
        if (free is None or free[i]) and foot.values.any():
            C = lin.C.window(ys, xs)
            inner = foot.y - ys.start, foot.x - xs.start
            h, w = foot.values.shape[:2]
            b = np.zeros(shape)
            for m in range(6):
                b[inner[0] : inner[0] + h, inner[1] : inner[1] + w] = foot.values[..., m]
                x = solver.solve_window(b, ys.start, xs.start, tolerance)
                X[..., m] = x
                R[..., m] = b - C.times(x)
        return Footprint(ys.start, xs.start, X), Footprint(ys.start, xs.start, R)

    solved = workers.map(columns, range(n))
    taken = [i for i in range(n) if free is None or free[i]]
    pairs = [(i, j) for i in taken for j in taken if i <= j and meet(solved[i][0], solved[j][0])]

    def block(pair: tuple[int, int]) -> NDArray[np.float64]:
        i, j = pair
        out = np.zeros((6, 6))
        for one, other in ((solved[i][0], lin.B[j]), (solved[i][1], solved[j][0])):
            _product(one.values, one.x, one.y, other.values, other.x, other.y, out)
        return out

    blocks = np.zeros((n, 6, n, 6))
    for (i, j), value in zip(pairs, workers.map(block, pairs), strict=True):
        blocks[i, :, j] -= value
        if i != j:
            blocks[j, :, i] -= value.T
    for i in range(n):
        blocks[i, :, i] += lin.A[i]
    S = blocks.reshape(6 * n, 6 * n)
    return Reduction((S + S.T) / 2, tuple(x for x, _ in solved))


def exact(lin: Linearisation, workers: Workers, tolerance: float = 1e-6) -> NDArray[np.float64]:
    """Return the exact reduced matrix of all frames, (6N, 6N); see :func:`reduce`."""
    return reduce(lin, workers, tolerance).S


def exact_sparse(lin: Linearisation) -> NDArray[np.float64]:
    """Return the exact reduced matrix by a sparse factorisation of C.

    The reference for :func:`exact`.
    """
    n = len(lin.B)
    factor = scipy.sparse.linalg.splu(lin.C.sparse())
    B = np.zeros((*lin.g_map.shape, 6 * n))
    for i, foot in enumerate(lin.B):
        B[(*foot.window, slice(6 * i, 6 * i + 6))] = foot.values
    B = B.reshape(-1, 6 * n)
    S = -B.T @ factor.solve(B)
    for i in range(n):
        S[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += lin.A[i]
    return np.asarray(S)


def solve(
    lin: Linearisation,
    free: NDArray[np.bool_],
    prior: tuple[NDArray[np.float64], NDArray[np.float64]],
    damping: float,
    workers: Workers,
    tolerance: float,
    outer: int,
    near: NDArray[np.float64] | None = None,
    here: Reduction | None = None,
    sure: NDArray[np.float64] | None = None,
) -> Step:
    """Solve the damped normal equations.

    The map goes out of them, the poses are solved for, the map answers.

    Args:
        lin: the normal equations.
        free: (N,) frames that move.
        prior: (N, 6, 6) and (N, 6), matrix and gradient that the measured poses add.
        damping: Levenberg-Marquardt, relative to the diagonal of the reduced matrix.
        workers: the threads.
        tolerance: relative residual of the reduced system at which the iterative road ends.
        outer: most products with the exact reduced matrix; 0 leaves the preconditioner's step.
        near: (6N, 6N) reduced matrix from earlier in the level: the preconditioner, in place of the
            lumped one.
        here: the reduction of ``lin`` itself: the direct road.
        sure: (6N, 6N) what of ``near`` is not noise in the map's slope, S0. A gradient g that is
            ``-S0 x`` but for noise of covariance S says ``S0 S^-1 S0`` about x, through
            ``S0 S^-1 g``: where noise is all there is, the measured poses stand.
    """
    n = len(lin.B)
    inner = min(1e-3, 0.1 * tolerance)
    solver = MapSolver(lin.C, inner, workers)
    answer, _ = solver.solve(-lin.g_map, inner)
    g = lin.g_pose + gather(lin, answer, workers)
    keep = np.repeat(free, 6)
    if sure is not None and near is not None:
        steps, length = _held_step(g.ravel()[keep], prior, near, sure, keep, damping)
        back, _ = solver.solve(spread(lin, steps, workers), inner)
        return Step(steps, answer - back, length)
    g = g + prior[1]
    S = here.S if here is not None else near if near is not None else lumped(lin, workers)
    extra = np.zeros_like(S)
    for i in range(n):
        extra[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = prior[0][i]
    bound = (S + extra)[np.ix_(keep, keep)]
    # a frame without points, or a direction nothing holds, must not make the matrix singular
    floor = 1e-12 * np.max(np.diag(bound), initial=1e-300)
    damp = damping * np.diag(bound) + floor
    factor = _factor(bound + np.diag(damp), floor)
    held = extra[np.ix_(keep, keep)]
    steps, back = np.zeros((n, 6)), np.zeros_like(lin.g_map)

    def whole(v: NDArray[np.float64]) -> NDArray[np.float64]:
        full = np.zeros(6 * n)
        full[keep] = v
        return full.reshape(n, 6)

    if here is not None:
        x = cho_solve(factor, -g.ravel()[keep])
        steps = whole(x)
        _spread_all(here.answers, steps, back, workers)
        return Step(steps, answer - back, float(x @ bound @ x))

    def product(v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        pose = whole(v)
        through, _ = solver.solve(spread(lin, pose, workers), inner)
        out = np.einsum("nij,nj->ni", lin.A, pose) - gather(lin, through, workers)
        return np.asarray(out.ravel()[keep] + held @ v), through

    x, Sx = _preconditioned(product, factor, damp, -g.ravel()[keep], tolerance, outer, back)
    if outer == 0:
        back, _ = solver.solve(spread(lin, whole(x), workers), inner)
    return Step(whole(x), answer - back, float(x @ Sx))


def _held_step(g, prior, S, sure, keep, damping):
    """Return the step (N, 6) that noise in the map's slope does not drive, and its length."""
    n = len(keep) // 6
    extra = np.zeros_like(S)
    for i in range(n):
        extra[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = prior[0][i]
    window = np.ix_(keep, keep)
    ridge = 1e-9 * np.diag(np.diag(S[window]) + np.max(np.diag(S[window]), initial=1e-300) * 1e-3)
    through = np.linalg.solve(S[window] + ridge, sure[window]).T
    bound = through @ sure[window]
    bound = (bound + bound.T) / 2 + extra[window]
    floor = 1e-12 * np.max(np.diag(bound), initial=1e-300)
    factor = _factor(bound + np.diag(damping * np.diag(bound) + floor), floor)
    x = -cho_solve(factor, through @ g + prior[1].ravel()[keep])
    steps = np.zeros(6 * n)
    steps[keep] = x
    return steps.reshape(n, 6), float(x @ bound @ x)


def _factor(matrix, floor):
    """Cholesky factor of a matrix that rounding may have left a little short of definite."""
    for lift in (0.0, 1e-9, 1e-6, 1e-3):
        try:
            return cho_factor(matrix + np.diag(lift * np.diag(matrix) + (lift > 0) * floor))
        except np.linalg.LinAlgError:
            continue
    return cho_factor(np.diag(np.abs(matrix).sum(axis=1) + floor))


def _preconditioned(product, factor, damp, b, tolerance, limit, back):
    """Conjugate gradients on ``S + diag(damp)``, preconditioned by a factor near it.

    ``product`` returns S v and the map's answer to v; the answer to the solution is added up in
    ``back``. Returns x and S x.
    """
    x, Sx = np.zeros_like(b), np.zeros_like(b)
    if limit == 0:
        x = cho_solve(factor, b)
        return x, b - damp * x
    r = b.copy()
    z = cho_solve(factor, r)
    p = z.copy()
    rz = r @ z
    goal = tolerance**2 * rz
    for _ in range(limit):
        if rz <= goal or rz <= 0:
            break
        Sp, through = product(p)
        q = Sp + damp * p
        curvature = p @ q
        if curvature <= 0:
            break
        alpha = rz / curvature
        x += alpha * p
        Sx += alpha * Sp
        back += alpha * through
        r -= alpha * q
        z = cho_solve(factor, r)
        before, rz = rz, r @ z
        p = z + rz / before * p
    return x, Sx


def meet(a: Footprint, b: Footprint) -> bool:
    """Whether two windows share nodes."""
    ha, wa = a.values.shape[:2]
    hb, wb = b.values.shape[:2]
    return bool(a.y < b.y + hb and b.y < a.y + ha and a.x < b.x + wb and b.x < a.x + wa)
