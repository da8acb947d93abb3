"""Eliminating the map: from the joint normal equations to the poses alone, and back.

The reduced matrix is ``S = A - B C^-1 B^T`` over the free frames. Its *lumped* bound replaces C by
the diagonal of its absolute row sums; that sum over the nodes two frames share needs no
factorisation and preconditions conjugate gradients on the exact S, each product of which is one
solve with C.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
import scipy.sparse.linalg
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from depthba.optimiser.linearise import Footprint, Linearisation, Workers

# Nodes beyond a footprint after which the map's answer to it has died away: where there are data it
# falls by about four from one node to the next.
REACH = 24


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
def _spread(values, x0, y0, v, out):
    """Add ``B^T v`` of one frame to the field ``out``."""
    for y in range(values.shape[0]):
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


def spread(lin: Linearisation, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``B^T pose``, (ny, nx), for pose (N, 6)."""
    field = np.zeros_like(lin.g_map)
    for foot, v in zip(lin.B, pose, strict=True):
        _spread(foot.values, foot.x, foot.y, v, field)
    return field


def gather(lin: Linearisation, field: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``B field``, (N, 6)."""
    out = np.zeros((len(lin.B), 6))
    for i, foot in enumerate(lin.B):
        _gather(foot.values, foot.x, foot.y, field, out[i])
    return out


def lumped(lin: Linearisation, workers: Workers) -> NDArray[np.float64]:
    """Return the lumped reduced matrix of all frames, (6N, 6N).

    It bounds the exact one from above.
    """
    n = len(lin.B)
    bound = lin.C.row_sums()
    S = np.zeros((n, 6, n, 6))
    pairs = [(i, j) for i in range(n) for j in range(i, n) if _meet(lin.B[i], lin.B[j])]

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


def exact(lin: Linearisation, workers: Workers, tolerance: float = 1e-10) -> NDArray[np.float64]:
    """Return the exact reduced matrix of all frames, (6N, 6N).

    That takes one solve with C for each of its columns.
    """
    n = len(lin.B)

    ny, nx = lin.g_map.shape

    def columns(i: int) -> NDArray[np.float64]:
        out = np.zeros((6, n, 6))
        foot = lin.B[i]
        if not foot.values.any():
            return out
        h, w = foot.values.shape[:2]
        y0, x0 = max(foot.y - REACH, 0), max(foot.x - REACH, 0)
        window = slice(y0, min(foot.y + h + REACH, ny)), slice(x0, min(foot.x + w + REACH, nx))
        C = lin.C.window(*window)
        field = np.zeros((ny, nx))
        for m in range(6):
            field[window] = 0.0
            field[foot.window] = foot.values[..., m]
            field[window] = C.solve(np.ascontiguousarray(field[window]), tolerance)[0]
            out[m] = gather(lin, field)
        return out

    S = -np.stack(workers.map(columns, range(n)))
    for i in range(n):
        S[i, :, i] += lin.A[i]
    S = S.reshape(6 * n, 6 * n)
    return np.asarray((S + S.T) / 2)


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
) -> Step:
    """Solve the damped normal equations.

    The map goes out of them, the poses are solved for, the map answers.

    Args:
        lin: the normal equations.
        free: (N,) frames that move.
        prior: (N, 6, 6) and (N, 6), matrix and gradient that the measured poses add.
        damping: Levenberg-Marquardt, relative to the diagonal of the reduced matrix.
        workers: the threads.
        tolerance: relative residual of the reduced system at which the correction stops.
        outer: most products with the exact reduced matrix; 0 leaves the lumped step uncorrected.
    """
    n = len(lin.B)
    inner = min(1e-3, 0.1 * tolerance)
    answer, _ = lin.C.solve(-lin.g_map, inner)
    g = lin.g_pose + gather(lin, answer) + prior[1]
    keep = np.repeat(free, 6)
    S = lumped(lin, workers)
    extra = np.zeros_like(S)
    for i in range(n):
        extra[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = prior[0][i]
    bound = (S + extra)[np.ix_(keep, keep)]
    # a frame without points, or a direction nothing holds, must not make the matrix singular
    floor = 1e-12 * np.max(np.diag(bound), initial=1e-300)
    damp = damping * np.diag(bound) + floor
    factor = cho_factor(bound + np.diag(damp))
    held = extra[np.ix_(keep, keep)]

    def product(v: NDArray[np.float64]) -> NDArray[np.float64]:
        full = np.zeros(6 * n)
        full[keep] = v
        pose = full.reshape(n, 6)
        through, _ = lin.C.solve(spread(lin, pose), inner)
        out = np.einsum("nij,nj->ni", lin.A, pose) - gather(lin, through)
        return np.asarray(out.ravel()[keep] + held @ v)

    x, Sx = _preconditioned(product, factor, damp, -g.ravel()[keep], tolerance, outer)
    pose = np.zeros(6 * n)
    pose[keep] = x
    steps = pose.reshape(n, 6)
    back, _ = lin.C.solve(spread(lin, steps), inner)
    return Step(steps, answer - back, float(x @ Sx))


def _preconditioned(product, factor, damp, b, tolerance, limit):
    """Conjugate gradients on ``S + diag(damp)``, preconditioned by the lumped factor.

    Returns x and S x.
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
        Sp = product(p)
        q = Sp + damp * p
        curvature = p @ q
        if curvature <= 0:
            break
        alpha = rz / curvature
        x += alpha * p
        Sx += alpha * Sp
        r -= alpha * q
        z = cho_solve(factor, r)
        before, rz = rz, r @ z
        p = z + rz / before * p
    return x, Sx


def _meet(a: Footprint, b: Footprint) -> bool:
    ha, wa = a.values.shape[:2]
    hb, wb = b.values.shape[:2]
    return bool(a.y < b.y + hb and b.y < a.y + ha and a.x < b.x + wb and b.x < a.x + wa)
