"""Sets of small integers as rows of 64-bit words, for Numba."""

from __future__ import annotations

import numba as nb
import numpy as np
from numba import types
from numba.extending import intrinsic

WORD = 64


@intrinsic
def population(typing_context, word):
    """Return how many bits of a uint64 are set."""

    def generate(context, builder, signature, arguments):
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


@intrinsic
def lowest(typing_context, word):
    """Return the place of the lowest set bit of a uint64 that is not 0."""

    def generate(context, builder, signature, arguments):
        return builder.cttz(arguments[0], context.get_constant(types.boolean, True))

    return types.uint64(types.uint64), generate


@nb.njit(inline="always")
def bit(i):
    """Return the uint64 in which only bit ``i`` (0 to 63) is set."""
    return nb.uint64(1) << nb.uint64(i)


@nb.njit(cache=True, nogil=True)
def size(row):
    """Return how many members a set has."""
    total = 0
    for word in row:
        total += nb.int64(population(word))
    return total


@nb.njit(cache=True, nogil=True)
def members(row):
    """Return the members of a set, ascending, int64."""
    out = np.empty(size(row), np.int64)
    k = 0
    for w in range(len(row)):
        word = row[w]
        while word:
            out[k] = w * WORD + nb.int64(lowest(word))
            word &= word - nb.uint64(1)
            k += 1
    return out
