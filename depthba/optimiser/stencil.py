"""The map's block of the normal equations: a symmetric nine-point stencil.

Points couple the four nodes of their cell, so a node is coupled to its eight neighbours.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from depthba.compiling import fast, inlined

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
