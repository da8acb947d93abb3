"""Sorting points into voxels, and their moments there."""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numpy as np

from depthba.compiling import kernel, part

# Of Jacobi's rotations: what is left falls with the cube, so that six are plenty.
SWEEPS = 12


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
def principal(first, last, scatter, values, axes):
    """Fill values (k, 3), ascending, and axes (k, 3, 3), right-handed columns, of some scatters.

    Eigenvalues and eigenvectors of symmetric (3, 3) matrices by Jacobi's rotations, which take a
    fraction of what LAPACK takes for so small ones.
    """
    A, V = np.empty((3, 3)), np.empty((3, 3))
    for j in range(first, last):
        A[:] = scatter[j]
        V[:] = 0.0
        V[0, 0] = V[1, 1] = V[2, 2] = 1.0
        for _ in range(SWEEPS):
            off = A[0, 1] ** 2 + A[0, 2] ** 2 + A[1, 2] ** 2
            if off <= 1e-30 * (A[0, 0] ** 2 + A[1, 1] ** 2 + A[2, 2] ** 2):
                break
            for p, q in ((0, 1), (0, 2), (1, 2)):
                if A[p, q] != 0.0:
                    _rotate(A, V, p, q)
        a, b, c = 0, 1, 2
        if A[a, a] > A[b, b]:
            a, b = b, a
        if A[b, b] > A[c, c]:
            b, c = c, b
        if A[a, a] > A[b, b]:
            a, b = b, a
        values[j, 0], values[j, 1], values[j, 2] = A[a, a], A[b, b], A[c, c]
        for i in range(3):
            axes[j, i, 0], axes[j, i, 1] = V[i, a], V[i, b]
        axes[j, 0, 2] = V[1, a] * V[2, b] - V[2, a] * V[1, b]
        axes[j, 1, 2] = V[2, a] * V[0, b] - V[0, a] * V[2, b]
        axes[j, 2, 2] = V[0, a] * V[1, b] - V[1, a] * V[0, b]


@part
def _rotate(A, V, p, q):
    """Turn axes p and q so that A[p, q] becomes 0 (Golub & Van Loan 2013, 8.5.2)."""
    tau = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
    t = 1.0 / (abs(tau) + np.sqrt(1.0 + tau * tau))
    t = t if tau >= 0.0 else -t
    c = 1.0 / np.sqrt(1.0 + t * t)
    s = t * c
    r = 3 - p - q
    A[p, p] -= t * A[p, q]
    A[q, q] += t * A[p, q]
    A[p, q] = A[q, p] = 0.0
    x, y = A[min(r, p), max(r, p)], A[min(r, q), max(r, q)]
    A[r, p] = A[p, r] = c * x - s * y
    A[r, q] = A[q, r] = s * x + c * y
    for i in range(3):
        x, y = V[i, p], V[i, q]
        V[i, p], V[i, q] = c * x - s * y, s * x + c * y


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
