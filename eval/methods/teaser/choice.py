"""Which of several largest cliques: the one whose differences agree best.

A graph often has many cliques of the largest size, alike but for a few vertices, and the paper
leaves open which one to take. Chance, or the order of the matches, should not decide: of two sets
of the same size the one with the smaller errors is the likelier, so members are swapped for others
as long as that lowers the sum of squares.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from eval.methods.teaser.bits import WORD, bit, lowest, population

LEAST_GAIN = 1e-9
"""Of a swap, as a share of the sum; less is rounding."""


@nb.njit(cache=True, nogil=True)
def most_consistent(adjacency, src, dst, clique):
    """Return a clique (m,) as large as ``clique`` (m,), ascending, that no swap makes better.

    Args:
        adjacency: the graph, (n, ceil(n / 64)).
        src: (n, 3), m.
        dst: (n, 3), m.
        clique: its vertices.

    """
    n, words = adjacency.shape
    m = len(clique)
    row = np.zeros(words, np.uint64)
    inside = np.zeros(n, np.bool_)
    for v in clique:
        row[v >> 6] |= bit(v & 63)
        inside[v] = True
    error = np.zeros(n)  # of each member, summed over the others
    for v in clique:
        for u in clique:
            error[v] += _gap(src, dst, u, v)
    total = error.sum()
    while True:
        most, enters, leaves = LEAST_GAIN * total, -1, -1
        for v in range(n):
            if inside[v]:
                continue
            met = 0
            for w in range(words):
                met += nb.int64(population(row[w] & adjacency[v, w]))
            if met != m - 1:
                continue
            u = _only(row, adjacency[v])
            gain = error[u]
            for k in range(n):
                if inside[k] and k != u:
                    gain -= _gap(src, dst, k, v)
            if gain > most:
                most, enters, leaves = gain, v, u
        if enters < 0:
            return np.flatnonzero(inside)
        inside[leaves], inside[enters] = False, True
        row[leaves >> 6] &= ~bit(leaves & 63)
        row[enters >> 6] |= bit(enters & 63)
        error[enters] = 0.0
        for k in range(n):
            if inside[k] and k != enters:
                gap = _gap(src, dst, k, enters)
                error[k] += gap - _gap(src, dst, k, leaves)
                error[enters] += gap


@nb.njit(cache=True, nogil=True)
def _only(row, other):
    """Return the first member of ``row`` that is not in ``other``."""
    for w in range(len(row)):
        word = row[w] & ~other[w]
        if word:
            return w * WORD + nb.int64(lowest(word))
    return -1


@nb.njit(cache=True, nogil=True)
def _gap(src, dst, i, j):
    """Return by how much the lengths from i to j differ, squared, m^2."""
    a = b = 0.0
    for axis in range(3):
        a += (src[j, axis] - src[i, axis]) ** 2
        b += (dst[j, axis] - dst[i, axis]) ** 2
    return (math.sqrt(b) - math.sqrt(a)) ** 2
