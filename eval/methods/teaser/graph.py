"""Which matches can hold together: Yang, Shi, Carlone, T-RO 2020, sections IV and V.

The difference of two points is a measurement that no translation changes, and its length one that
no rotation changes either. Without a scale to find, two matches are consistent where both frames
agree on that length; right matches are all consistent with each other, a clique.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from eval.methods.teaser.bits import WORD, bit, population

Floats = NDArray[np.float64]
Words = NDArray[np.uint64]


@nb.njit(cache=True, nogil=True)
def consistency_graph(src, dst, tolerance):
    """Return the graph of consistent matches.

    Args:
        src: (n, 3), m.
        dst: (n, 3), the points that they were matched with, m.
        tolerance: by how much the lengths of a difference may differ, m: twice the bound on noise.

    Returns:
        (n, ceil(n / 64)) uint64, row i the set of neighbours of match i; never itself.

    """
    n = len(src)
    adjacency = np.zeros((n, (n + WORD - 1) // WORD), np.uint64)
    # A row's own memory is contiguous per coordinate, so that the inner loop runs in SIMD.
    sx, sy, sz = src[:, 0].copy(), src[:, 1].copy(), src[:, 2].copy()
    dx, dy, dz = dst[:, 0].copy(), dst[:, 1].copy(), dst[:, 2].copy()
    close = np.empty(n, np.uint8)
    for i in range(n):
        for j in range(i + 1, n):
            a, b, c = sx[j] - sx[i], sy[j] - sy[i], sz[j] - sz[i]
            d, e, f = dx[j] - dx[i], dy[j] - dy[i], dz[j] - dz[i]
            gap = math.sqrt(d * d + e * e + f * f) - math.sqrt(a * a + b * b + c * c)
            close[j] = abs(gap) <= tolerance
        for j in range(i + 1, n):
            if close[j]:
                adjacency[i, j >> 6] |= bit(j & 63)
                adjacency[j, i >> 6] |= bit(i & 63)
    return adjacency


@nb.njit(cache=True, nogil=True)
def degrees(adjacency):
    """Return (n,) int64, how many neighbours each vertex has."""
    out = np.zeros(len(adjacency), np.int64)
    for i in range(len(adjacency)):
        for word in adjacency[i]:
            out[i] += nb.int64(population(word))
    return out


def edge_count(adjacency: Words) -> int:
    """Return how many pairs of matches are consistent."""
    return int(degrees(adjacency).sum()) // 2
