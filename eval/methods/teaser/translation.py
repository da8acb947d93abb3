"""A translation from points, some of them wrong: truncated least squares, axis by axis.

Yang, Shi, Carlone, T-RO 2020, section VI, Algorithm 2 ("adaptive voting"). Which scalars agree with
an estimate changes only where the estimate enters or leaves one's interval; between two such places
the best estimate is a mean. So all sets that can be the answer are tried, in order.
"""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True)
def vote(values, bound, excluded):
    """Return the scalar that most of ``values`` (n,) agree with.

    Args:
        values: each the truth plus noise, or wrong.
        bound: largest noise.
        excluded: what a value costs that does not agree; one that does costs its square error.

    """
    n = len(values)
    middle = np.mean(values)  # squares of what is near 0 lose no digits in the differences below
    x = values - middle
    ends = np.concatenate((x - bound, x + bound))
    order = np.argsort(ends, kind="mergesort")  # on ties intervals open before others close
    count, total, squares = 0, 0.0, 0.0
    best, least = 0.0, np.inf
    for k in range(2 * n - 1):
        i = order[k]
        if i < n:
            count += 1
            total += x[i]
            squares += x[i] * x[i]
        else:
            count -= 1
            total -= x[i - n]
            squares -= x[i - n] * x[i - n]
        if count:
            mean = total / count
            cost = squares - total * mean + excluded * (n - count)
            if cost < least:
                least, best = cost, mean
    return best + middle


@nb.njit(cache=True, nogil=True)
def voted_translation(offsets, bound, excluded):
    """Return the translation t (3,), m, and which ``offsets`` (n, 3), m, agree with it: (n,) bool.

    An offset agrees where it is within ``bound``, m, of t along every axis; for ``excluded`` see
    `vote`.
    """
    t = np.empty(3)
    for axis in range(3):
        t[axis] = vote(offsets[:, axis].copy(), bound, excluded)
    agree = np.ones(len(offsets), np.bool_)
    for k in range(len(offsets)):
        for axis in range(3):
            agree[k] &= abs(offsets[k, axis] - t[axis]) <= bound
    return t, agree
