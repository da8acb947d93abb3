"""Point clusters: the sums that say all of a set of points that a plane through it needs.

A cluster is the symmetric ``C = [[Σ p pᵀ, Σ p], [Σ pᵀ, N]]`` (4, 4), in m², m and 1: what the
products of the points' homogeneous coordinates sum to. Moved by a pose it is ``T C Tᵀ``, and sets
are joined by adding: however many points there are, a cost or a step visits only clusters.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@nb.njit(cache=True, nogil=True)
def cluster_points(points, slot, count):
    """Sum points by slot.

    Args:
        points: (n, 3), m, float32 or float64; summed in double precision.
        slot: (n,) the cluster of each.
        count: number of clusters.

    Returns:
        (count, 4, 4) float64.

    """
    C = np.zeros((count, 4, 4))
    for k in range(points.shape[0]):
        c = C[slot[k]]
        x, y, z = np.float64(points[k, 0]), np.float64(points[k, 1]), np.float64(points[k, 2])
        c[0, 0] += x * x
        c[0, 1] += x * y
        c[0, 2] += x * z
        c[0, 3] += x
        c[1, 1] += y * y
        c[1, 2] += y * z
        c[1, 3] += y
        c[2, 2] += z * z
        c[2, 3] += z
        c[3, 3] += 1.0
    for k in range(count):
        for i in range(1, 4):
            for j in range(i):
                C[k, i, j] = C[k, j, i]
    return C


@nb.njit(cache=True, nogil=True)
def move_clusters(T, C):
    """Return clusters ``C`` (k, 4, 4) after poses ``T`` (k, 4, 4)."""
    out = np.empty_like(C)
    half = np.empty((4, 4))
    for k in range(C.shape[0]):
        t, c, moved = T[k], C[k], out[k]
        for i in range(4):
            for j in range(4):
                half[i, j] = (t[i, 0] * c[0, j] + t[i, 1] * c[1, j]) + (
                    t[i, 2] * c[2, j] + t[i, 3] * c[3, j]
                )
        for i in range(4):
            for j in range(i + 1):
                moved[i, j] = (half[i, 0] * t[j, 0] + half[i, 1] * t[j, 1]) + (
                    half[i, 2] * t[j, 2] + half[i, 3] * t[j, 3]
                )
                moved[j, i] = moved[i, j]
    return out


@nb.njit(cache=True, nogil=True)
def join_clusters(C, owner, count):
    """Return (count, 4, 4), the sums of clusters (k, 4, 4) by ``owner`` (k,)."""
    joined = np.zeros((count, 4, 4))
    for k in range(C.shape[0]):
        whole = joined[owner[k]]
        for i in range(4):
            for j in range(4):
                whole[i, j] += C[k, i, j]
    return joined


def covariances(C: Floats) -> tuple[Floats, Floats]:
    """Return the centres (k, 3), m, and biased covariances (k, 3, 3), m², of clusters (k, 4, 4)."""
    N = C[:, 3, 3]
    centre = C[:, :3, 3] / N[:, None]
    return centre, C[:, :3, :3] / N[:, None, None] - centre[:, :, None] * centre[:, None, :]
