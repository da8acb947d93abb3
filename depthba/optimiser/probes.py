"""Kernels that ask what the points say, beyond the normal equations themselves.

All take where a frame's points meet the map, as :class:`depthba.optimiser.feet.Feet` holds it.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numpy as np

from depthba.compiling import inlined, kernel


@inlined
def _shares(a, b):
    """Shares of a cell's four nodes at a fraction of it."""
    return (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b


@kernel
def contributions(
    inverse_noise, shares, on, arms, slopes, norm2, residuals, arm, weights, groups, pulls, scores
):  # fmt: skip
    """Write what every point adds to the gradients.

    ``pulls`` (n,) gets its weighted residual, 0 where it does not count. What it adds to the
    frame's own gradient goes to ``scores`` (kinds, groups, 6), by its group in each row of
    ``groups`` (kinds, n). ``arm`` is the sensor's centre relative to the pivot.
    """
    for k in range(shares.shape[0]):
        if on[k] == 0.0 or weights[k] <= 0.0:
            pulls[k] = 0.0
            continue
        wr = shares[k] * weights[k] * np.float64(inverse_noise[k]) ** 2 / norm2[k] * residuals[k]
        pulls[k] = wr
        gx, gy = slopes[0, k], slopes[1, k]
        lx, ly, lz = arms[0, k] + arm[0], arms[1, k] + arm[1], arms[2, k] + arm[2]
        for kind in range(groups.shape[0]):
            s = scores[kind, groups[kind, k]]
            s[0] -= wr * gx
            s[1] -= wr * gy
            s[2] += wr
            s[3] += wr * (ly + lz * gy)
            s[4] += wr * (-lz * gx - lx)
            s[5] += wr * (-lx * gy + ly * gx)


@kernel
def answered(cells, fractions, pulls, groups, answer, left, low, scores):
    """Add what the map's answer makes of the points' contributions to another frame's ``scores``.

    ``answer`` (h, w, 6) is that frame's ``C^-1 B^T`` over the window from node (left, low) on.
    """
    height, width = answer.shape[0], answer.shape[1]
    for k in range(pulls.shape[0]):
        x, y = cells[0, k] - left, cells[1, k] - low
        if pulls[k] == 0.0 or x < 0 or y < 0 or x + 1 >= width or y + 1 >= height:
            continue
        h00, h10, h01, h11 = _shares(fractions[0, k], fractions[1, k])
        wr = pulls[k]
        h00, h10, h01, h11 = wr * h00, wr * h10, wr * h01, wr * h11
        n00, n10, n01, n11 = answer[y, x], answer[y, x + 1], answer[y + 1, x], answer[y + 1, x + 1]
        for m in range(6):
            v = h00 * n00[m] + h10 * n10[m] + h01 * n01[m] + h11 * n11[m]
            for kind in range(groups.shape[0]):
                scores[kind, groups[kind, k], m] += v


@kernel
def noise_gradient(
    inverse_noise, shares, on, cells, fractions, norm2, weights, draws, gradient
):  # fmt: skip
    """Add to ``gradient`` (ny, nx) what residuals ``draws`` (n,) times the points' sigma would."""
    for k in range(shares.shape[0]):
        if on[k] == 0.0 or weights[k] <= 0.0:
            continue
        h00, h10, h01, h11 = _shares(fractions[0, k], fractions[1, k])
        x, y = cells[0, k], cells[1, k]
        e = shares[k] * weights[k] * inverse_noise[k] / np.sqrt(norm2[k]) * draws[k]
        gradient[y, x] -= h00 * e
        gradient[y, x + 1] -= h10 * e
        gradient[y + 1, x] -= h01 * e
        gradient[y + 1, x + 1] -= h11 * e


@kernel
def slope_noise(
    inverse_noise, shares, on, cells, fractions, arms, norm2, arm, weights, noise, A, B, bx, by
):  # fmt: skip
    """Accumulate ``A`` (6, 6) and ``B`` (h, w, 6) of Jacobians that hold slope noise alone.

    ``noise`` (ny, nx, 3) are nodes of a map that is nothing but noise. Only the lower triangle of
    ``A`` is filled.
    """
    j, h = np.zeros(6), np.zeros(4)
    for k in range(shares.shape[0]):
        x, y = cells[0, k] - bx, cells[1, k] - by
        if on[k] == 0.0 or weights[k] <= 0.0:
            continue
        if x < 0 or y < 0 or x + 1 >= B.shape[1] or y + 1 >= B.shape[0]:
            continue
        w = shares[k] * weights[k] * np.float64(inverse_noise[k]) ** 2 / norm2[k]
        h[0], h[1], h[2], h[3] = _shares(fractions[0, k], fractions[1, k])
        gx, gy = 0.0, 0.0
        for m in range(4):
            node = noise[cells[1, k] + m // 2, cells[0, k] + m % 2]
            gx += h[m] * node[1]
            gy += h[m] * node[2]
        lx, ly, lz = arms[0, k] + arm[0], arms[1, k] + arm[1], arms[2, k] + arm[2]
        j[0], j[1], j[2] = -gx, -gy, 0.0
        j[3], j[4], j[5] = lz * gy, -lz * gx, -lx * gy + ly * gx
        for m in range(6):
            for n in range(m + 1):
                A[m, n] += w * j[m] * j[n]
        for m in range(4):
            node = B[y + m // 2, x + m % 2]
            for n in range(6):
                node[n] -= h[m] * w * j[n]


@kernel
def leverages(inverse_noise, shares, on, cells, fractions, norm2, weights, own, out):
    """Write to ``out`` (n,) how much every point pulls the map to itself.

    0: not at all, 1: the map follows it. ``own`` (ny, nx) is the map's diagonal, which is right on
    average over evenly spread points. NaN off the map.
    """
    for k in range(shares.shape[0]):
        out[k] = np.nan
        if on[k] == 0.0 or weights[k] <= 0.0:
            continue
        h00, h10, h01, h11 = _shares(fractions[0, k], fractions[1, k])
        x, y = cells[0, k], cells[1, k]
        out[k] = shares[k] * weights[k] * np.float64(inverse_noise[k]) ** 2 / norm2[k] * (
            h00 * h00 / own[y, x] + h10 * h10 / own[y, x + 1]
            + h01 * h01 / own[y + 1, x] + h11 * h11 / own[y + 1, x + 1]
        )  # fmt: skip
