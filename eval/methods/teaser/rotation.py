"""A rotation from differences of points, some of them wrong: GNC with truncated least squares.

Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception: From
Non-Minimal Solvers to Global Outlier Rejection", RA-L 2020, Algorithm 1 and eqs. (13)-(14).
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True)
def gnc_rotation(a, b, bound, factor, most, least_change):
    """Return the rotation of ``b = R a`` for most rows.

    Args:
        a: (m, 3), m.
        b: (m, 3), m.
        bound: largest ``|b - R a|`` that counts as noise, m.
        factor: by which the surrogate cost becomes less convex per iteration, over 1.
        most: iterations.
        least_change: of the cost, m^2, under which to stop.

    Returns:
        R (3, 3); the rows (m,) bool that agree; the cost at the end, m^2, infinite where the
        first fit was good enough as it is; and the iterations that changed weights.

    """
    m = len(a)
    limit = bound * bound
    weights = np.ones(m)
    squares = np.empty(m)
    cost, mu, iterations = math.inf, 0.0, 0
    R = np.eye(3)
    for iteration in range(most):
        R = _weighted_rotation(a, b, weights)
        largest = 0.0
        for k in range(m):
            squares[k] = 0.0
            for i in range(3):
                e = b[k, i] - (R[i, 0] * a[k, 0] + R[i, 1] * a[k, 1] + R[i, 2] * a[k, 2])
                squares[k] += e * e
            largest = max(largest, squares[k])
        if iteration == 0:
            if 2 * largest <= limit:
                break
            mu = limit / (2 * largest - limit)
        before, cost = cost, 0.0
        for k in range(m):
            cost += weights[k] * squares[k]
            if squares[k] >= limit * (mu + 1) / mu:
                weights[k] = 0.0
            elif squares[k] <= limit * mu / (mu + 1):
                weights[k] = 1.0
            else:
                weights[k] = math.sqrt(limit * mu * (mu + 1) / squares[k]) - mu
        mu *= factor
        iterations += 1
        if abs(cost - before) < least_change:
            break
    return R, weights >= 0.5, cost, iterations


@nb.njit(cache=True, nogil=True)
def _weighted_rotation(a, b, weights):
    """Return the R (3, 3) that minimises ``sum w |b - R a|^2`` (Kabsch, by SVD)."""
    H = np.zeros((3, 3))
    for k in range(len(a)):
        for i in range(3):
            for j in range(3):
                H[i, j] += weights[k] * b[k, i] * a[k, j]
    U, _, Vt = np.linalg.svd(H)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        U[:, 2] = -U[:, 2]
    return U @ Vt
