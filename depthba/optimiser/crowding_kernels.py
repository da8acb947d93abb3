"""Kernels that find which points of a frame lie close together, and what their residuals share."""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numpy as np

from depthba.compiling import kernel

# Bits of a voxel's number along each axis; voxels so far apart that theirs are the same are one.
BITS = 21
MIXER = np.uint64(0x9E3779B97F4A7C15)


@kernel
def sort(points, side, bits, place, count):
    """Write to ``place`` (n,) the voxel of each point (3, n), to ``count`` how many each has.

    Voxels are the slots of a hash table with open addresses, of ``2**bits`` slots (Knuth 1998,
    6.4): more than there are points.
    """
    mask, last = np.int64((1 << BITS) - 1), np.int64((1 << bits) - 1)
    keys = np.full(1 << bits, -1, np.int64)
    for i in range(points.shape[1]):
        key = np.int64(0)
        for a in range(3):
            key = (key << BITS) | (np.int64(np.floor(points[a, i] / side)) & mask)
        k = np.int64((np.uint64(key) * MIXER) >> np.uint64(64 - bits))
        while keys[k] != key and keys[k] >= 0:
            k = (k + 1) & last
        keys[k] = key
        count[k] += 1.0
        place[i] = k


@kernel
def scatter(place, residuals, count, out):
    """Add to ``out`` (classes, 5) what residuals (n,) scatter; NaN is none.

    By the power of two of how many points their place has: the number of places, of points, the sum
    of the logarithm of how many their place has, the squares of places' sums, and those of points.
    """
    slots = len(count)
    n, total, square = np.zeros(slots), np.zeros(slots), np.zeros(slots)
    for i in range(len(place)):
        e = np.float64(residuals[i])
        if e == e:
            n[place[i]] += 1.0
            total[place[i]] += e
            square[place[i]] += e * e
    for k in range(slots):
        if n[k] > 0.0:
            size = np.log2(count[k])
            row = out[min(int(size), len(out) - 1)]
            row[0] += 1.0
            row[1] += n[k]
            row[2] += n[k] * size
            row[3] += total[k] * total[k]
            row[4] += square[k]
