"""Sorting points into voxels, and their moments there."""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numpy as np

from depthba.compiling import kernel


@kernel
def to_map(first, last, points, frame, T, out):
    """Bring some of the points (n, 3) of the given frames (n,) into the map frame."""
    for i in range(first, last):
        pose = T[frame[i]]
        for a in range(3):
            out[i, a] = (
                pose[a, 0] * points[i, 0]
                + pose[a, 1] * points[i, 1]
                + pose[a, 2] * points[i, 2]
                + pose[a, 3]
            )


@kernel
def extent(first, last, x, these, least, most):
    """Fill ``least`` and ``most`` (3,) with the first and the last coordinate of some points."""
    least[:], most[:] = np.inf, -np.inf
    for k in range(first, last):
        for a in range(3):
            least[a] = min(least[a], x[these[k], a])
            most[a] = max(most[a], x[these[k], a])


@kernel
def number(first, last, x, these, side, least, spans, out):
    """Write to ``out`` the number of some points' voxels in a box of ``spans`` (3,) voxels."""
    for k in range(first, last):
        n = np.int64(0)
        for a in range(3):
            c = np.int64(np.floor(x[these[k], a] / side))
            n = n * spans[a] + c - least[a]
        out[k] = n


@kernel
def sort_by(bins, these, order, at):
    """Write to ``order`` (n,) some points sorted by bin; ``at`` (bins + 1,): zeros.

    The sort is stable. Afterwards a bin begins where ``at`` has it.
    """
    for k in bins:
        at[k + 1] += 1
    for k in range(len(at) - 1):
        at[k + 1] += at[k]
    for i in range(len(bins)):
        order[at[bins[i]]] = these[i]
        at[bins[i]] += 1


@kernel
def split(order, at, frame, begins, voxel):
    """Split points that are sorted by bin, each of which ends where ``at`` has it, by frame.

    Fills where each run begins, and the number of its bin, those without points left out; returns
    how many runs and how many bins there are.
    """
    runs, bins, i = 0, 0, 0
    for end in at[:-1]:
        if i == end:
            continue
        before = -1
        while i < end:
            now = frame[order[i]]
            if now != before:
                begins[runs], voxel[runs], before = i, bins, now
                runs += 1
            i += 1
        bins += 1
    return runs, bins


@kernel
def moments(first, last, order, begins, x, w, weight, mean, spread):
    """Fill weight, mean and scatter of some runs of points; each ends where the next begins."""
    for j in range(first, last):
        total = m0 = m1 = m2 = 0.0
        for i in order[begins[j] : begins[j + 1]]:
            total += w[i]
            m0 += w[i] * x[i, 0]
            m1 += w[i] * x[i, 1]
            m2 += w[i] * x[i, 2]
        m0, m1, m2 = m0 / total, m1 / total, m2 / total
        s00 = s10 = s11 = s20 = s21 = s22 = 0.0
        for i in order[begins[j] : begins[j + 1]]:
            d0, d1, d2 = x[i, 0] - m0, x[i, 1] - m1, x[i, 2] - m2
            s00 += w[i] * d0 * d0
            s10 += w[i] * d1 * d0
            s11 += w[i] * d1 * d1
            s20 += w[i] * d2 * d0
            s21 += w[i] * d2 * d1
            s22 += w[i] * d2 * d2
        weight[j] = total
        mean[j, 0], mean[j, 1], mean[j, 2] = m0, m1, m2
        spread[j, 0, 0], spread[j, 1, 1], spread[j, 2, 2] = s00, s11, s22
        spread[j, 0, 1] = spread[j, 1, 0] = s10
        spread[j, 0, 2] = spread[j, 2, 0] = s20
        spread[j, 1, 2] = spread[j, 2, 1] = s21


@kernel
def runs(order, begins, these, out):
    """Write to ``out`` the points of some runs, one run after the other."""
    k = 0
    for j in these:
        for i in order[begins[j] : begins[j + 1]]:
            out[k] = i
            k += 1


@kernel
def pool(group, spread, out):
    """Add the scatter (n, 3, 3) of each run to its group's in ``out`` (k, 3, 3)."""
    for j in range(len(group)):
        for a in range(3):
            for b in range(3):
                out[group[j], a, b] += spread[j, a, b]


@kernel
def gather(
    first, last, these, points, weights, frame, source,
    points_out, weights_out, frame_out, source_out,
):  # fmt: skip
    """Take some points, with all that is known of them."""
    for k in range(first, last):
        i = these[k]
        for a in range(3):
            points_out[k, a] = points[i, a]
        weights_out[k], frame_out[k], source_out[k] = weights[i], frame[i], source[i]
