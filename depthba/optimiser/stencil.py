"""The map's block of the normal equations.

A symmetric nine-point stencil, and conjugate gradients on it.

Points couple the four nodes of their cell, so a node is coupled to its eight neighbours. Where
there are data the block is like a mass matrix and Jacobi-preconditioned conjugate gradients
converge in tens of iterations.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from depthba.compiling import fast, fast_part, inlined, kernel
from depthba.optimiser.workers import Workers

Field = NDArray[np.float64]

# Relative residual down to which single precision is enough.
SINGLE = 1e-5
# Nodes below which threads wait for each other longer than they work.
FEW = 400_000


@dataclass(frozen=True)
class Stencil:
    """Symmetric matrix over the nodes of a grid; every array is (ny, nx)."""

    own: Field
    right: Field
    """Coupling of (y, x) with (y, x + 1)."""
    up: Field
    """Coupling of (y, x) with (y + 1, x)."""
    up_right: Field
    """Coupling of (y, x) with (y + 1, x + 1)."""
    up_left: Field
    """Coupling of (y, x + 1) with (y + 1, x)."""

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> Stencil:
        """Return a matrix whose values are not set."""
        return cls(*(np.empty(shape) for _ in range(5)))

    def times(self, v: Field) -> Field:
        """Return the product with a field (ny, nx)."""
        out = np.empty_like(v)
        _times(self.own, self.right, self.up, self.up_right, self.up_left, v, out)
        return out

    def row_sums(self) -> Field:
        """Return the absolute row sums (ny, nx): a diagonal that bounds the matrix from above."""
        right, up = np.abs(self.right), np.abs(self.up)
        up_right, up_left = np.abs(self.up_right), np.abs(self.up_left)
        total = np.abs(self.own)
        total[:, :-1] += right[:, :-1]
        total[:, 1:] += right[:, :-1]
        total[:-1] += up[:-1]
        total[1:] += up[:-1]
        total[:-1, :-1] += up_right[:-1, :-1]
        total[1:, 1:] += up_right[:-1, :-1]
        total[:-1, 1:] += up_left[:-1, :-1]
        total[1:, :-1] += up_left[:-1, :-1]
        return total

    def window(self, y: slice, x: slice) -> Stencil:
        """Return the matrix over a window of the nodes, as if all others were held at zero."""
        return Stencil(
            *(
                np.ascontiguousarray(f[y, x])
                for f in (self.own, self.right, self.up, self.up_right, self.up_left)
            )
        )

    def solve(self, b: Field, tolerance: float = 1e-6, limit: int = 500) -> tuple[Field, int]:
        """Solve for one right-hand side (ny, nx); see :class:`MapSolver`."""
        return MapSolver(self, tolerance).solve(b, tolerance, limit)

    def sparse(self) -> sp.csc_matrix:
        """Return the same matrix as a SciPy sparse matrix over the flattened nodes."""
        ny, nx = self.own.shape
        n = ny * nx
        node = np.arange(n).reshape(ny, nx)
        pairs = [
            (node[:, :-1], node[:, 1:], self.right[:, :-1]),
            (node[:-1], node[1:], self.up[:-1]),
            (node[:-1, :-1], node[1:, 1:], self.up_right[:-1, :-1]),
            (node[:-1, 1:], node[1:, :-1], self.up_left[:-1, :-1]),
        ]
        i = np.concatenate([p[0].ravel() for p in pairs])
        j = np.concatenate([p[1].ravel() for p in pairs])
        v = np.concatenate([p[2].ravel() for p in pairs])
        upper = sp.coo_matrix((v, (i, j)), shape=(n, n))
        return sp.csc_matrix(upper + upper.T + sp.diags(self.own.ravel()))


@inlined
def _border(own, right, up, up_right, up_left, v, y, x):
    """Return the product at a node on the border of the grid."""
    ny, nx = own.shape
    total = own[y, x] * v[y, x]
    if x + 1 < nx:
        total += right[y, x] * v[y, x + 1]
    if x > 0:
        total += right[y, x - 1] * v[y, x - 1]
    if y + 1 < ny:
        total += up[y, x] * v[y + 1, x]
        if x + 1 < nx:
            total += up_right[y, x] * v[y + 1, x + 1]
        if x > 0:
            total += up_left[y, x - 1] * v[y + 1, x - 1]
    if y > 0:
        total += up[y - 1, x] * v[y - 1, x]
        if x > 0:
            total += up_right[y - 1, x - 1] * v[y - 1, x - 1]
        if x + 1 < nx:
            total += up_left[y - 1, x] * v[y - 1, x + 1]
    return total


@fast
def _times(own, right, up, up_right, up_left, v, out):
    ny, nx = own.shape
    for x in range(nx):
        out[0, x] = _border(own, right, up, up_right, up_left, v, 0, x)
        out[ny - 1, x] = _border(own, right, up, up_right, up_left, v, ny - 1, x)
    for y in range(1, ny - 1):
        out[y, 0] = _border(own, right, up, up_right, up_left, v, y, 0)
        out[y, nx - 1] = _border(own, right, up, up_right, up_left, v, y, nx - 1)
        here, below, above = v[y], v[y - 1], v[y + 1]
        o, r, u, u0 = own[y], right[y], up[y], up[y - 1]
        d, d0, a, a0 = up_right[y], up_right[y - 1], up_left[y], up_left[y - 1]
        for x in range(1, nx - 1):
            out[y, x] = (
                o[x] * here[x]
                + r[x] * here[x + 1]
                + r[x - 1] * here[x - 1]
                + u[x] * above[x]
                + u0[x] * below[x]
                + d[x] * above[x + 1]
                + d0[x - 1] * below[x - 1]
                + a[x - 1] * above[x - 1]
                + a0[x] * below[x + 1]
            )


class MapSolver:
    """Conjugate gradients on a stencil, preconditioned by its diagonal.

    The matrix is scaled to a diagonal of 1 once and laid out with a border of zeros, so that the
    sweeps know no edges. Loose tolerances run in single precision, which halves the memory that
    every iteration fetches. Sums go row by row: the result does not depend on the threads.
    """

    def __init__(self, C: Stencil, tolerance: float, workers: Workers | None = None) -> None:
        """Scale the matrix; later changes to it do not matter.

        Args:
            C: the matrix.
            tolerance: the tightest that will be asked for.
            workers: threads among which a sweep is dealt out; None: the caller's own.
        """
        ny, nx = C.own.shape
        self._scale = np.empty((ny, nx))
        dtype = np.float32 if tolerance >= SINGLE else np.float64
        self._couplings = np.zeros((4, ny + 2, nx + 2), dtype)
        self._workers = workers
        self._bands = [(0, ny)]
        if workers is not None and ny * nx >= FEW:
            self._bands = workers.bands(ny)
        self._map(lambda *band: _reciprocal_root(C.own, self._scale, *band))
        fields = C.right, C.up, C.up_right, C.up_left
        self._map(lambda *band: _scaled(self._scale, *fields, self._couplings, *band))

    def _map(self, sweep: Callable[[int, int], None]) -> None:
        if self._workers is None or len(self._bands) == 1:
            for band in self._bands:
                sweep(*band)
        else:
            self._workers.map(lambda band: sweep(*band), self._bands)

    def solve(self, b: Field, tolerance: float, limit: int = 500) -> tuple[Field, int]:
        """Solve for one right-hand side (ny, nx).

        ``tolerance`` bounds the residual relative to ``b`` in the norm of the preconditioner.
        Returns the solution and the number of iterations.
        """
        ny, nx = b.shape
        dtype = self._couplings.dtype
        x, r, q = (np.zeros((ny, nx), dtype) for _ in range(3))
        p, spare = (np.zeros((ny + 2, nx + 2), dtype) for _ in range(2))
        sums = np.zeros(ny)
        self._map(lambda *band: _begin(b, self._scale, r, sums, *band))
        rr = float(sums.sum())
        goal, beta, n = tolerance**2 * rr, 0.0, 0
        while rr > goal and n < limit:
            n += 1
            self._map(
                lambda *band, p=p, spare=spare, beta=beta: _direct_band(
                    self._couplings, 0, 0, r, beta, p, spare, q, sums, *band
                )
            )
            p, spare = spare, p
            curvature = float(sums.sum())
            if not curvature > 0.0:
                break
            alpha = rr / curvature
            self._map(lambda *band, p=p, alpha=alpha: _advance_band(alpha, p, q, x, r, sums, *band))
            before, rr = rr, float(sums.sum())
            beta = rr / before
        return self._scale * x, n

    def solve_window(self, b: Field, y: int, x: int, tolerance: float, limit: int = 500) -> Field:
        """Solve over the window of the nodes from (y, x) on, as if all others were held at zero.

        ``b`` has the shape of the window. The caller's own thread does it all.
        """
        h, w = b.shape
        scale = self._scale[y : y + h, x : x + w]
        out = np.zeros((h, w), self._couplings.dtype)
        _conjugate_gradients(self._couplings, y, x, scale * b, out, tolerance, limit)
        return scale * out


@kernel
def _reciprocal_root(own, scale, first, last):
    for y in range(first, last):
        for x in range(own.shape[1]):
            scale[y, x] = 1.0 / np.sqrt(own[y, x])


@kernel
def _scaled(scale, right, up, up_right, up_left, out, first, last):
    ny, nx = scale.shape
    for y in range(first, last):
        for x in range(nx):
            s = scale[y, x]
            if x + 1 < nx:
                out[0, y + 1, x + 1] = s * right[y, x] * scale[y, x + 1]
            if y + 1 < ny:
                out[1, y + 1, x + 1] = s * up[y, x] * scale[y + 1, x]
                if x + 1 < nx:
                    out[2, y + 1, x + 1] = s * up_right[y, x] * scale[y + 1, x + 1]
                    out[3, y + 1, x + 1] = scale[y, x + 1] * up_left[y, x] * scale[y + 1, x]


@kernel
def _begin(b, scale, r, sums, first, last):
    """Scale the right-hand side into ``r``; its squared norm by rows goes to ``sums``."""
    for y in range(first, last):
        total = 0.0
        for x in range(b.shape[1]):
            v = b[y, x] * scale[y, x]
            r[y, x] = v
            total += v * v
        sums[y] = total


@fast_part
def _next_row(r, beta, p, y, out):
    for x in range(r.shape[1]):
        out[x + 1] = r[y, x] + beta * p[y + 1, x + 1]


# The product with a row goes in two: of more arrays at once the compiler does not prove that they
# lie apart, and gives up on vector instructions.
@fast_part
def _straight(right, up, up_below, here, above, below, q):
    for x in range(q.shape[0]):
        q[x] = (
            here[x + 1]
            + right[x + 1] * here[x + 2]
            + right[x] * here[x]
            + up[x + 1] * above[x + 1]
            + up_below[x + 1] * below[x + 1]
        )


@fast_part
def _across(across, across_below, back, back_below, here, above, below, q):
    """Add the diagonal neighbours to ``q``; return ``here . q``."""
    total = q.dtype.type(0.0)
    for x in range(q.shape[0]):
        v = q[x] + (
            across[x + 1] * above[x + 2]
            + across_below[x] * below[x]
            + back[x] * above[x]
            + back_below[x + 1] * below[x + 2]
        )
        q[x] = v
        total += v * here[x + 1]
    return total


@fast_part
def _direct(couplings, y0, x0, r, beta, p, after, q, sums, first, last):
    """Take the next direction ``after = r + beta p`` and ``q``, its product with the matrix.

    ``p`` and ``after`` (h + 2, w + 2) have a border of zeros; (y0, x0) is the window's corner in
    the matrix. The products ``after . q`` by rows go to ``sums``. The rows next to the band belong
    to others: their directions are worked out again.
    """
    h, w = r.shape
    beta = r.dtype.type(beta)
    end = x0 + w + 2
    ghosts = np.zeros((2, w + 2), r.dtype)
    if first > 0:
        _next_row(r, beta, p, first - 1, ghosts[0])
    if last < h:
        _next_row(r, beta, p, last, ghosts[1])
    _next_row(r, beta, p, first, after[first + 1])
    for y in range(first, last):
        if y + 1 < last:
            _next_row(r, beta, p, y + 1, after[y + 2])
        below = ghosts[0] if y == first else after[y]
        here = after[y + 1]
        above = ghosts[1] if y + 1 == last else after[y + 2]
        at, under = y0 + y + 1, y0 + y
        _straight(
            couplings[0, at, x0:end], couplings[1, at, x0:end], couplings[1, under, x0:end],
            here, above, below, q[y],
        )  # fmt: skip
        total = _across(
            couplings[2, at, x0:end], couplings[2, under, x0:end], couplings[3, at, x0:end],
            couplings[3, under, x0:end], here, above, below, q[y],
        )  # fmt: skip
        sums[y] = total


@fast_part
def _advance(alpha, p, q, x, r, sums, first, last):
    """Step along ``p``: ``x += alpha p``, ``r -= alpha q``; ``r . r`` by rows goes to ``sums``."""
    alpha = r.dtype.type(alpha)
    for y in range(first, last):
        total = r.dtype.type(0.0)
        for k in range(r.shape[1]):
            x[y, k] += alpha * p[y + 1, k + 1]
            v = r[y, k] - alpha * q[y, k]
            r[y, k] = v
            total += v * v
        sums[y] = total


@fast
def _direct_band(couplings, y0, x0, r, beta, p, after, q, sums, first, last):
    _direct(couplings, y0, x0, r, beta, p, after, q, sums, first, last)


@fast
def _advance_band(alpha, p, q, x, r, sums, first, last):
    _advance(alpha, p, q, x, r, sums, first, last)


@kernel
def _conjugate_gradients(couplings, y0, x0, b, x, tolerance, limit):
    h, w = b.shape
    r = b.astype(x.dtype)
    q = np.empty_like(x)
    p, after = np.zeros((h + 2, w + 2), x.dtype), np.zeros((h + 2, w + 2), x.dtype)
    sums = np.empty(h)
    rr = 0.0
    for y in range(h):
        for k in range(w):
            rr += b[y, k] * b[y, k]
    goal, beta = tolerance * tolerance * rr, 0.0
    for _ in range(limit):
        if not rr > goal:
            break
        _direct(couplings, y0, x0, r, beta, p, after, q, sums, 0, h)
        p, after = after, p
        curvature = sums.sum()
        if not curvature > 0.0:
            break
        _advance(rr / curvature, p, q, x, r, sums, 0, h)
        before, rr = rr, sums.sum()
        beta = rr / before
