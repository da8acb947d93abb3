"""The reduced matrix ``S = A - B C^-1 B^T``: exact, by a reference, or bounded from above."""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse.linalg
from numpy.typing import NDArray

from depthba.compiling import kernel
from depthba.optimiser.coupling import meet
from depthba.optimiser.linearise import Footprint, Linearisation
from depthba.optimiser.map_solver import MapSolver
from depthba.optimiser.workers import Workers

# Nodes beyond a footprint after which the map's answer to it has died away: where there are data it
# falls by about four from one node to the next.
REACH = 12
# Nodes in the windows of all frames, per point, up to which the direct road is the shorter one.
DIRECT = 0.15


@kernel
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


@kernel
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
    ``R C^-1 R^T``: an error of second order, so a tolerance of 1e-3 leaves 1e-6, and single
    precision is enough for X whatever the tolerance.
    """
    n = len(lin.B)
    spans = windows(lin)

    def columns(i: int) -> tuple[Footprint, Footprint]:
        foot, (ys, xs) = lin.B[i], spans[i]
        shape = ys.stop - ys.start, xs.stop - xs.start
        X, R = np.zeros((*shape, 6), np.float32), np.zeros((*shape, 6), np.float32)
        if (free is None or free[i]) and foot.values.any():
            C = lin.C.window(ys, xs)
            solver = MapSolver(C, tolerance)
            inner = foot.y - ys.start, foot.x - xs.start
            h, w = foot.values.shape[:2]
            b = np.zeros(shape)
            for m in range(6):
                b[inner[0] : inner[0] + h, inner[1] : inner[1] + w] = foot.values[..., m]
                X[..., m], _ = solver.solve(b, tolerance)
                R[..., m] = b - C.times(X[..., m].astype(float))
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
