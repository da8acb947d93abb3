"""The map's block of the normal equations: a symmetric nine-point stencil, and conjugate gradients on it.

Points couple the four nodes of their cell, so a node is coupled to its eight neighbours. Where there are data the
block is like a mass matrix and Jacobi-preconditioned conjugate gradients converge in tens of iterations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Field = NDArray[np.float64]


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

    def solve(self, b: Field, tolerance: float = 1e-6, limit: int = 500) -> tuple[Field, int]:
        """Solve for one right-hand side (ny, nx) by Jacobi-preconditioned conjugate gradients.

        ``tolerance`` bounds the residual relative to ``b`` in the norm of the preconditioner. Returns the solution
        and the number of iterations.
        """
        x = np.zeros_like(b)
        n = _conjugate_gradients(
            self.own, self.right, self.up, self.up_right, self.up_left, b, x, tolerance, limit
        )
        return x, n

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


@nb.njit(cache=True, nogil=True)
def _times(own, right, up, up_right, up_left, v, out):
    ny, nx = own.shape
    for y in range(ny):
        for x in range(nx):
            out[y, x] = own[y, x] * v[y, x]
        for x in range(nx - 1):
            out[y, x] += right[y, x] * v[y, x + 1]
            out[y, x + 1] += right[y, x] * v[y, x]
        if y > 0:
            for x in range(nx):
                out[y, x] += up[y - 1, x] * v[y - 1, x]
            for x in range(nx - 1):
                out[y, x + 1] += up_right[y - 1, x] * v[y - 1, x]
                out[y, x] += up_left[y - 1, x] * v[y - 1, x + 1]
        if y < ny - 1:
            for x in range(nx):
                out[y, x] += up[y, x] * v[y + 1, x]
            for x in range(nx - 1):
                out[y, x] += up_right[y, x] * v[y + 1, x + 1]
                out[y, x + 1] += up_left[y, x] * v[y + 1, x]


@nb.njit(cache=True, nogil=True)
def _dot(a, b):
    total = 0.0
    for y in range(a.shape[0]):
        row = 0.0
        for x in range(a.shape[1]):
            row += a[y, x] * b[y, x]
        total += row
    return total


@nb.njit(cache=True, nogil=True)
def _conjugate_gradients(own, right, up, up_right, up_left, b, x, tolerance, limit):
    ny, nx = own.shape
    r = b.copy()
    z = r / own
    p = z.copy()
    q = np.empty_like(b)
    rz = _dot(r, z)
    goal = tolerance * tolerance * rz
    for n in range(limit):
        if rz <= goal or rz <= 0.0:
            return n
        _times(own, right, up, up_right, up_left, p, q)
        alpha = rz / _dot(p, q)
        for i in range(ny):
            for k in range(nx):
                x[i, k] += alpha * p[i, k]
                r[i, k] -= alpha * q[i, k]
                z[i, k] = r[i, k] / own[i, k]
        before, rz = rz, _dot(r, z)
        beta = rz / before
        for i in range(ny):
            for k in range(nx):
                p[i, k] = z[i, k] + beta * p[i, k]
    return limit
