"""A better clique by exchanges of vertices, before any proof.

Vertices that all members know join; where there is none, one that all but a single member know
takes that one's place. What left may not return for a while, and among those that can enter the
one that moved longest ago does (Pullan, Hoos, "Dynamic Local Search for the Maximum Clique
Problem", JAIR 2006, with age in the place of chance: the same graph gives the same clique).
"""

from __future__ import annotations

import numba as nb
import numpy as np

from eval.methods.teaser.bits import bit

REST = 7
"""Steps for which a vertex that left stays out, at least."""


@nb.njit(cache=True, nogil=True)
def exchanged(adjacency, clique, steps):
    """Return the largest clique (k,) met in some steps from ``clique`` (m,); not in any order.

    Args:
        adjacency: the graph, (n, ceil(n / 64)).
        clique: its vertices.
        steps: joins and exchanges.

    """
    n = len(adjacency)
    inside = np.zeros(n, np.bool_)
    strangers = np.zeros(n, np.int64)  # members that a vertex does not know, itself not counted
    moved = np.full(n, -n, np.int64)  # the step in which it last did
    for v in clique:
        inside[v] = True
        for u in range(n):
            strangers[u] += u != v and adjacency[v, u >> 6] & bit(u & 63) == 0
    count = len(clique)
    best = clique.copy()
    for step in range(steps):
        enters, least = -1, 2
        for u in range(n):
            if inside[u] or strangers[u] > 1 or (strangers[u] and step - moved[u] < REST):
                continue
            if strangers[u] < least or (strangers[u] == least and moved[u] < moved[enters]):
                enters, least = u, strangers[u]
        if enters < 0:
            # Nothing fits any more: the one that fits best comes in, at the cost of several.
            for u in range(n):
                if inside[u] or step - moved[u] < REST:
                    continue
                if enters < 0 or strangers[u] < strangers[enters]:
                    enters = u
        if enters < 0:
            break
        if strangers[enters]:
            for v in range(n):
                if inside[v] and adjacency[enters, v >> 6] & bit(v & 63) == 0:
                    inside[v] = False
                    moved[v] = step
                    count -= 1
                    for u in range(n):
                        strangers[u] -= u != v and adjacency[v, u >> 6] & bit(u & 63) == 0
        inside[enters] = True
        moved[enters] = step
        count += 1
        for u in range(n):
            strangers[u] += u != enters and adjacency[enters, u >> 6] & bit(u & 63) == 0
        if count > len(best):
            best = np.flatnonzero(inside)
    return best
