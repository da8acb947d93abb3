"""The largest clique of a graph, proven so by branch and bound.

A vertex of core number c lies in no clique of more than c + 1 vertices (Rossi, Gleich, Gebremedhin,
"Parallel Maximum Clique Algorithms with Applications to Network Analysis", SISC 2015), which leaves
few vertices once a greedy search has found a good one. On these, sets of vertices are words of
bits, and a colouring in order of the vertices bounds what a set can hold (San Segundo,
Rodríguez-Losada, Jiménez, "An exact bit-parallel algorithm for the maximum clique problem", COR
2011), improved by recolouring (Tomita et al., "A Simple and Faster Branch-and-Bound Algorithm for
Finding a Maximum Clique", WALCOM 2010).
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from eval.methods.teaser.bits import WORD, bit, lowest, size
from eval.methods.teaser.graph import Words, degrees
from eval.methods.teaser.local_search import exchanged

Ints = NDArray[np.int64]

BRANCHES = 500
"""Of the tree, between two looks at the clock."""
EXCHANGES = 4
"""Steps of the search for a better clique before the proof, per vertex left."""


@dataclass(frozen=True, eq=False)
class Clique:
    """The largest clique that was found."""

    vertices: Ints
    """(m,), ascending."""
    proven: bool
    """Whether no larger one can be; False where time ran out."""
    branches: int
    """Of the search tree."""


def maximum_clique(adjacency: Words, seconds: float = 30.0) -> Clique:
    """Return the largest clique of a graph; among equals always the same one.

    Args:
        adjacency: (n, ceil(n / 64)), as `consistency_graph` gives it.
        seconds: after which the best clique so far must do.

    """
    until = time.monotonic() + seconds
    cores, removal = core_numbers(adjacency)
    # Those removed last are the best connected; taken first, they need few colours.
    order = removal[::-1]
    ordered = subgraph(adjacency, order)
    best = greedy_clique(ordered, cores[order])
    kept = np.flatnonzero(cores[order] >= len(best))
    if not len(kept):
        return Clique(np.sort(order[best]), True, 0)
    few = subgraph(ordered, kept)
    state = _state(few, int(cores.max()), len(best))
    if _branch(few, *state, 0):
        return Clique(np.sort(order[best]), True, 0)
    better = exchanged(few, np.flatnonzero(np.isin(kept, best)), EXCHANGES * len(few))
    if len(better) > len(best):
        best = kept[better]
        state = _state(few, int(cores.max()), len(best))
    while not (proven := bool(_branch(few, *state, BRANCHES))) and time.monotonic() < until:
        pass
    counts, found = state[-2:]
    if counts[_BEST] > len(best):
        best = kept[found[: counts[_BEST]]]
    return Clique(np.sort(order[best]), proven, int(counts[_BRANCHES]))


@nb.njit(cache=True, nogil=True)
def core_numbers(adjacency):
    """Return each vertex's core number, and the order in which vertices of least degree go.

    Batagelj, Zaversnik, "An O(m) Algorithm for Cores Decomposition of Networks", 2003.

    Returns:
        (n,) int64 core numbers, and (n,) int64 vertices in the order of their removal.

    """
    n = len(adjacency)
    degree = degrees(adjacency)
    start = np.zeros(n + 1, np.int64)  # of the vertices of each degree in `order`
    for v in range(n):
        start[degree[v] + 1] += 1
    for d in range(n):
        start[d + 1] += start[d]
    place = np.empty(n, np.int64)
    order = np.empty(n, np.int64)
    free = start.copy()
    for v in range(n):
        place[v] = free[degree[v]]
        order[place[v]] = v
        free[degree[v]] += 1
    for k in range(n):
        v = order[k]
        for w in range(adjacency.shape[1]):
            word = adjacency[v, w]
            while word:
                u = w * WORD + nb.int64(lowest(word))
                word &= word - nb.uint64(1)
                if degree[u] <= degree[v]:
                    continue
                # Swap u with the first of its degree, which then has one vertex less.
                first = start[degree[u]]
                other = order[first]
                order[first], order[place[u]] = u, other
                place[other], place[u] = place[u], first
                start[degree[u]] += 1
                degree[u] -= 1
    return degree, order


@nb.njit(cache=True, nogil=True)
def subgraph(adjacency, vertices):
    """Return the graph (m, ceil(m / 64)) of some vertices (m,), renumbered in their order."""
    m = len(vertices)
    number = np.full(len(adjacency), -1, np.int64)
    for k in range(m):
        number[vertices[k]] = k
    out = np.zeros((m, (m + WORD - 1) // WORD), np.uint64)
    for k in range(m):
        row = adjacency[vertices[k]]
        for w in range(len(row)):
            word = row[w]
            while word:
                j = number[w * WORD + nb.int64(lowest(word))]
                word &= word - nb.uint64(1)
                if j >= 0:
                    out[k, j >> 6] |= bit(j & 63)
    return out


@nb.njit(cache=True, nogil=True)
def greedy_clique(adjacency, cores):
    """Return the largest clique (m,) found by taking the first candidate again and again.

    Args:
        adjacency: the graph, vertices in the order in which they are to be taken.
        cores: (n,) their core numbers: what a vertex cannot better is not tried.

    """
    n, words = adjacency.shape
    best = np.empty(0, np.int64)
    chosen = np.empty(n, np.int64)
    candidates = np.empty(words, np.uint64)
    for v in range(n):
        if cores[v] < len(best):
            continue
        candidates[:] = adjacency[v]
        chosen[0] = v
        count = 1
        for w in range(words):
            while candidates[w]:
                u = w * WORD + nb.int64(lowest(candidates[w]))
                chosen[count] = u
                count += 1
                for x in range(w, words):
                    candidates[x] &= adjacency[u, x]
        if count > len(best):
            best = chosen[:count].copy()
    return best


_DEPTH, _BEST, _BRANCHES = 0, 1, 2
"""Places in the counts of a search."""


def _state(adjacency: Words, deepest: int, best: int) -> tuple[NDArray, ...]:
    """Return what `_branch` works on, at the root of the tree."""
    n, words = adjacency.shape
    depth = deepest + 2
    candidates = np.zeros((depth, words), np.uint64)
    every = np.arange(n)
    np.bitwise_or.at(candidates[0], every // WORD, np.uint64(1) << (every % WORD).astype(np.uint64))
    order, colour = np.empty((depth, n), np.int32), np.empty((depth, n), np.int32)
    length = np.full(depth, -1, np.int64)
    return (
        candidates, order, colour, length,
        np.empty((n + 1, words), np.uint64), np.empty(depth, np.int64),
        np.array([0, best, 0]), np.empty(depth, np.int64),
    )  # fmt: skip


@nb.njit(cache=True, nogil=True)
def _branch(adjacency, candidates, order, colour, length, classes, chosen, counts, found, budget):
    """Go on with a search for some branches; tell whether it is done.

    Level d of the tree has d chosen vertices; row d of ``candidates`` holds what can still join
    them, rows of ``order`` and ``colour`` those that could lead to a larger clique (``length`` of
    them, -1 where not coloured yet), cheapest last.
    """
    words = adjacency.shape[1]
    d = counts[_DEPTH]
    while True:
        if length[d] < 0:
            length[d] = _coloured(
                adjacency, candidates[d], counts[_BEST] - d, classes, order[d], colour[d]
            )
        k = length[d] - 1
        if k < 0 or d + colour[d, k] <= counts[_BEST]:
            # Those before need no more colours: none of them leads to a larger clique.
            if d == 0:
                counts[_DEPTH] = 0
                return True
            d -= 1
            continue
        if budget == 0:
            counts[_DEPTH] = d
            return False
        length[d] = k
        budget -= 1
        counts[_BRANCHES] += 1
        v = order[d, k]
        candidates[d, v >> 6] &= ~bit(v & 63)
        chosen[d] = v
        empty = True
        for w in range(words):
            candidates[d + 1, w] = candidates[d, w] & adjacency[v, w]
            empty &= candidates[d + 1, w] == 0
        if not empty:
            d += 1
            length[d] = -1
        elif d + 1 > counts[_BEST]:
            counts[_BEST] = d + 1
            found[: d + 1] = chosen[: d + 1]


@nb.njit(cache=True, nogil=True)
def _coloured(adjacency, candidates, few, classes, order, colour):
    """Colour candidates so that neighbours differ; list those that need more than ``few`` colours.

    Any clique among those not listed and the first k listed has no more vertices than the k-th's
    colour. Returns the number listed.
    """
    words = len(candidates)
    left = candidates.copy()
    listed = 0
    k = 0
    remaining = size(left)
    while remaining:
        k += 1
        if k <= few:
            classes[k, :] = 0
        free = left.copy()
        for w in range(words):
            while free[w]:
                b = free[w] & (~free[w] + nb.uint64(1))
                v = w * WORD + nb.int64(lowest(b))
                left[w] &= ~b
                free[w] &= ~b
                remaining -= 1
                for x in range(w, words):
                    free[x] &= ~adjacency[v, x]
                if k <= few:
                    classes[k, w] |= b
                elif not _recoloured(adjacency, classes, v, few):
                    order[listed] = v
                    colour[listed] = k
                    listed += 1
    return listed


@nb.njit(cache=True, nogil=True)
def _recoloured(adjacency, classes, v, few):
    """Try to give ``v`` one of the first ``few`` colours by moving one vertex to another one."""
    words = adjacency.shape[1]
    for k in range(1, few + 1):
        met = nb.int64(-1)
        several = False
        for w in range(words):
            word = classes[k, w] & adjacency[v, w]
            if word:
                if met >= 0 or word & (word - nb.uint64(1)):
                    several = True
                    break
                met = w * WORD + nb.int64(lowest(word))
        if several:
            continue
        if met >= 0:
            to = 0
            for other in range(1, few + 1):
                if other == k:
                    continue
                clash = False
                for w in range(words):
                    if classes[other, w] & adjacency[met, w]:
                        clash = True
                        break
                if not clash:
                    to = other
                    break
            if to == 0:
                continue
            classes[k, met >> 6] &= ~bit(met & 63)
            classes[to, met >> 6] |= bit(met & 63)
        classes[k, v >> 6] |= bit(v & 63)
        return True
    return False
