"""Solving with the map's block: conjugate gradients, preconditioned by symmetric Gauss-Seidel.

Scaled to a diagonal of 1 the matrix is ``L + I + L^T``, and with ``M = (I + L)(I + L)^T`` each
product with the preconditioned matrix is one sweep back and one forth over the nodes:
``t = (I + L)^-T p``, then ``t + (I + L)^-1 (p - t)`` (Eisenstat 1981). That costs no more than a
product with the matrix, and takes less than half the iterations of scaling alone.

A sweep waits at every node for the one before. So the grid is cut into strips of rows, and all
strips go at once, side by side in the lanes of vector instructions: nodes are swept by row within
the strip, then column, then strip. Where two strips meet, the last row of one waits for the first
of the next, which was long before.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from depthba.compiling import fast, fast_part, kernel
from depthba.optimiser.stencil import Stencil
from depthba.optimiser.workers import Workers

Field = NDArray[np.float64]

# Relative residual down to which single precision is enough.
SINGLE = 1e-5
# Strips side by side.
LANES = 16
# Nodes below which threads wait for each other longer than they work.
FEW = 800_000
# Groups of strips, each for one thread, from that size on.
GROUPS = 4


class MapSolver:
    """Conjugate gradients on a stencil, preconditioned by symmetric Gauss-Seidel.

    The matrix is scaled and laid out once. Loose tolerances run in single precision, which halves
    the memory that every iteration fetches. The result does not depend on the threads.
    """

    def __init__(self, C: Stencil, tolerance: float, workers: Workers | None = None) -> None:
        """Lay out the matrix; later changes to it do not matter.

        Args:
            C: the matrix.
            tolerance: the tightest that will be asked for.
            workers: threads among which the sweeps over a large map are dealt out; None: the
                caller's own does it all.
        """
        ny, nx = C.own.shape
        self._workers = workers
        self._groups = range(1 if workers is None or ny * nx < FEW else GROUPS)
        strips = LANES * len(self._groups)
        # two rows at least: nodes of one row within the strips must not be coupled
        self._rows = max(2, -(-ny // strips))
        dtype = np.float32 if tolerance >= SINGLE else np.float64
        self._scale = 1.0 / np.sqrt(C.own)
        width = (nx + 2) * LANES
        self._couplings = np.zeros((len(self._groups), 4, self._rows + 1, width), dtype)
        fields = C.right, C.up, C.up_right, C.up_left
        self._map(lambda g: _lay_out(self._scale, *fields, g, self._couplings[g]))

    def _map(self, work: Callable[[int], None]) -> None:
        if self._workers is None or len(self._groups) == 1:
            for g in self._groups:
                work(g)
        else:
            self._workers.map(work, self._groups)

    def solve(self, b: Field, tolerance: float, limit: int = 500) -> tuple[Field, int]:
        """Solve for one right-hand side (ny, nx).

        ``tolerance`` bounds the residual relative to ``b`` in the norm of the preconditioner.
        Returns the solution and the number of iterations.
        """
        dtype, width = self._couplings.dtype, self._couplings.shape[-1]
        vectors = np.zeros((5, len(self._groups), self._rows, width), dtype)
        self._map(lambda g: _take(b, self._scale, g, vectors[0, g]))
        n = (
            _conjugate_gradients(self._couplings, vectors, tolerance, limit)
            if len(self._groups) == 1
            else self._side_by_side(vectors, tolerance, limit)
        )
        out = np.empty(b.shape)
        self._map(lambda g: _give(vectors[1, g], self._scale, g, out))
        return out, n

    def _side_by_side(self, vectors: NDArray[np.floating], tolerance: float, limit: int) -> int:
        """Do what :func:`_conjugate_gradients` does, groups of strips apart."""
        couplings = self._couplings
        d, t, p, r, x = vectors
        sums = np.zeros(d.shape[:2])

        def back(of: NDArray[np.floating], beta: float) -> None:
            self._map(lambda g: _back_group(couplings[g], of[g], beta, p[g], t[g], d[g]))
            for g in self._groups:
                _back_seam(couplings, g, t, d, p)

        def forth() -> float:
            self._map(lambda g: _forth_group(couplings[g], p[g], t[g], d[g], sums[g]))
            for g in self._groups:
                _forth_seam(couplings, g, p, t, d, sums)
            return float(sums.sum())

        def advance(alpha: float) -> float:
            self._map(lambda g: _advance_group(alpha, p[g], t[g], x[g], r[g], sums[g]))
            return float(sums.sum())

        forth()
        rr = advance(-1.0)
        goal, beta, n = tolerance**2 * rr, 0.0, 0
        while rr > goal and n < limit:
            n += 1
            back(r, beta)
            curvature = forth()
            if not curvature > 0.0:
                break
            before, rr = rr, advance(rr / curvature)
            beta = rr / before
        back(x, 0.0)
        return n


@kernel
def _lay_out(scale, right, up, up_right, up_left, group, out):
    """Fill the couplings (4, rows + 1, width) of a group: right, up, up right, up left.

    Row r + 1 belongs to row r of the strips, row 0 to the one below the strip.
    """
    ny, nx = scale.shape
    rows = out.shape[1] - 1
    for lane in range(LANES):
        first = (group * LANES + lane) * rows - 1
        for row in range(rows + 1):
            y = first + row
            if y < 0 or y >= ny:
                continue
            for x in range(nx):
                s, at = scale[y, x], (x + 1) * LANES + lane
                if x + 1 < nx:
                    out[0, row, at] = s * right[y, x] * scale[y, x + 1]
                if y + 1 < ny:
                    out[1, row, at] = s * up[y, x] * scale[y + 1, x]
                    if x + 1 < nx:
                        out[2, row, at] = s * up_right[y, x] * scale[y + 1, x + 1]
                        out[3, row, at] = scale[y, x + 1] * up_left[y, x] * scale[y + 1, x]


@kernel
def _take(b, scale, group, out):
    ny, nx = b.shape
    rows = out.shape[0]
    for lane in range(LANES):
        first = (group * LANES + lane) * rows
        for y in range(first, min(first + rows, ny)):
            for x in range(nx):
                out[y - first, (x + 1) * LANES + lane] = b[y, x] * scale[y, x]


@kernel
def _give(values, scale, group, out):
    ny, nx = out.shape
    rows = values.shape[0]
    for lane in range(LANES):
        first = (group * LANES + lane) * rows
        for y in range(first, min(first + rows, ny)):
            for x in range(nx):
                out[y, x] = values[y - first, (x + 1) * LANES + lane] * scale[y, x]


# Rows of lanes are walked from 0 on, and back by unsigned indices: only then does the compiler
# prove that no index counts from the end, and makes vector instructions.
@fast_part
def _less_below(couplings, row, below, values):
    """Take off what the row of strips below adds; ``row`` is that of their couplings."""
    up, up_right, up_left = couplings[1, row], couplings[2, row], couplings[3, row]
    for j in range(values.shape[0] - 2 * LANES):
        values[j + LANES] -= (
            up[j + LANES] * below[j + LANES]
            + up_right[j] * below[j]
            + up_left[j + LANES] * below[j + 2 * LANES]
        )


@fast_part
def _less_above(couplings, row, above, values):
    up, up_right, up_left = couplings[1, row], couplings[2, row], couplings[3, row]
    for j in range(values.shape[0] - 2 * LANES):
        values[j + LANES] -= (
            up[j + LANES] * above[j + LANES]
            + up_right[j + LANES] * above[j + 2 * LANES]
            + up_left[j] * above[j]
        )


@fast_part
def _along(right, values):
    """Substitute along a row, from left to right."""
    for j in range(values.shape[0] - 2 * LANES):
        values[j + LANES] -= right[j] * values[j]


@fast_part
def _back_along(right, values):
    end = np.uintp(values.shape[0] - LANES - 1)
    for i in range(values.shape[0] - 2 * LANES):
        j = end - np.uintp(i)
        values[j] -= right[j] * values[j + np.uintp(LANES)]


@fast_part
def _directed(r, beta, p, t):
    for j in range(p.shape[0]):
        v = r[j] + beta * p[j]
        p[j] = v
        t[j] = v


@fast_part
def _difference(p, t, d):
    for j in range(p.shape[0]):
        d[j] = p[j] - t[j]


@fast_part
def _product(p, t, d):
    """Add ``d`` to ``t``; return ``p . t``."""
    total = p.dtype.type(0.0)
    for j in range(p.shape[0]):
        v = t[j] + d[j]
        t[j] = v
        total += p[j] * v
    return total


@fast_part
def _back(couplings, r, beta, p, t, d):
    """Take the next direction ``p = r + beta p``, ``t = (I + L)^-T p`` and ``d = p - t``.

    All rows of a group but the first, which :func:`_seam_back` does.
    """
    rows = len(p)
    beta = p.dtype.type(beta)
    for y in range(rows - 1, -1, -1):
        _directed(r[y], beta, p[y], t[y])
        if y < rows - 1:
            _less_above(couplings, y + 1, t[y + 1], t[y])
        if y > 0:
            _back_along(couplings[0, y + 1], t[y])
            _difference(p[y], t[y], d[y])


@fast_part
def _seam_back(couplings, group, t, d, p):
    """Do the first rows of a group's strips: they wait for the last of the strips before."""
    last, edge = t[group, -1], np.zeros(t.shape[2], t.dtype)
    for j in range(len(edge) - 1):
        edge[j + 1] = last[j]
    for x in range(0, len(edge), LANES):
        edge[x] = t[group - 1, -1, x + LANES - 1] if group > 0 else 0.0
    row = t[group, 0]
    _less_below(couplings[group], 0, edge, row)
    _back_along(couplings[group, 0, 1], row)
    _difference(p[group, 0], row, d[group, 0])


@fast_part
def _forth(couplings, p, t, d, sums):
    """Put ``(I + L)^-1 d`` into ``d`` and add it to ``t``; ``p . t`` by rows goes to ``sums``.

    All rows of a group but the last, which :func:`_seam_forth` does.
    """
    for y in range(len(d) - 1):
        if y > 0:
            _less_below(couplings, y, d[y - 1], d[y])
        _along(couplings[0, y + 1], d[y])
        sums[y] = _product(p[y], t[y], d[y])


@fast_part
def _seam_forth(couplings, group, p, t, d, sums):
    """Do the last rows of a group's strips: they wait for the first of the strips behind."""
    first, edge = d[group, 0], np.zeros(d.shape[2], d.dtype)
    for j in range(len(edge) - 1):
        edge[j] = first[j + 1]
    for x in range(0, len(edge), LANES):
        edge[x + LANES - 1] = d[group + 1, 0, x] if group + 1 < len(d) else 0.0
    y = d.shape[1] - 1
    row = d[group, y]
    _less_below(couplings[group], y, d[group, y - 1], row)
    _less_above(couplings[group], y + 1, edge, row)
    _along(couplings[group, 0, y + 1], row)
    sums[group, y] = _product(p[group, y], t[group, y], row)


@fast_part
def _advance(alpha, p, t, x, r, sums):
    """Step along ``p``: ``x += alpha p``, ``r -= alpha t``; ``r . r`` by rows goes to ``sums``."""
    alpha = p.dtype.type(alpha)
    for y in range(len(p)):
        _stepped(alpha, p[y], x[y])
        sums[y] = _lessened(alpha, t[y], r[y])


@fast_part
def _stepped(alpha, p, x):
    for j in range(p.shape[0]):
        x[j] += alpha * p[j]


@fast_part
def _lessened(alpha, t, r):
    total = r.dtype.type(0.0)
    for j in range(r.shape[0]):
        v = r[j] - alpha * t[j]
        r[j] = v
        total += v * v
    return total


@fast
def _back_group(couplings, r, beta, p, t, d):
    _back(couplings, r, beta, p, t, d)


@fast
def _back_seam(couplings, group, t, d, p):
    _seam_back(couplings, group, t, d, p)


@fast
def _forth_group(couplings, p, t, d, sums):
    _forth(couplings, p, t, d, sums)


@fast
def _forth_seam(couplings, group, p, t, d, sums):
    _seam_forth(couplings, group, p, t, d, sums)


@fast
def _advance_group(alpha, p, t, x, r, sums):
    _advance(alpha, p, t, x, r, sums)


@fast
def _conjugate_gradients(couplings, vectors, tolerance, limit):
    """Solve on one group; the right-hand side is in ``vectors[0]``, the answer in ``vectors[1]``.

    Returns the number of iterations.
    """
    d, t, p, r, x = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4]
    sums = np.zeros(d.shape[:2])
    _forth(couplings[0], p[0], t[0], d[0], sums[0])
    _seam_forth(couplings, 0, p, t, d, sums)
    # the residual is what the sweep left in t
    _advance(-1.0, p[0], t[0], x[0], r[0], sums[0])
    rr = sums.sum()
    goal, beta, n = tolerance * tolerance * rr, 0.0, 0
    while rr > goal and n < limit:
        n += 1
        _back(couplings[0], r[0], beta, p[0], t[0], d[0])
        _seam_back(couplings, 0, t, d, p)
        _forth(couplings[0], p[0], t[0], d[0], sums[0])
        _seam_forth(couplings, 0, p, t, d, sums)
        curvature = sums.sum()
        if not curvature > 0.0:
            break
        _advance(rr / curvature, p[0], t[0], x[0], r[0], sums[0])
        before, rr = rr, sums.sum()
        beta = rr / before
    _back(couplings[0], x[0], 0.0, p[0], t[0], d[0])
    _seam_back(couplings, 0, t, d, p)
    return n
