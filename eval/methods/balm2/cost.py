"""The cost of planes, Σ N λ_min, with its gradient and its exact Hessian.

λ_min is the least eigenvalue of the covariance of all points of a plane, in the world: N λ_min is
the sum of their squared distances from the best plane, which thereby is gone from the problem. Pose
j moves by ``x_j = [w, d]``: ``R <- Exp(w) R``, ``p <- Exp(w) p + d``.

With the plane's normal u, its other axes u_l, its centre m, a point q = m + r and what moves it
along u, ``a = [q x u, u]``, the terms of second order of N λ_min are

    H_jj += 2 Σ_j (a aᵀ + e B)           e = u.r, B the second derivative of u.Exp(w) q
    H_jk -= 2/N (Σ_j a) (Σ_k a)ᵀ         the centre moves, too
    H_jk += Σ_l 2 / (N (λ - λ_l)) c_jl c_klᵀ     the normal turns, c_jl = Σ_j ((u_l.r) a + e a_l)

and the gradient is ``J_j = 2 Σ_j e a``. All sums are moments of clusters, so a plane costs what the
frames that see it cost; the points are not visited.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from depthba import se3
from eval.methods.balm2.clusters import Floats, covariances, join_clusters, move_clusters
from eval.methods.balm2.voxels import Planes


@dataclass(frozen=True, eq=False)
class Quadratic:
    """``cost + J.x + xᵀ H x / 2`` in the steps of all frames, rotation before translation."""

    cost: float
    """m²."""
    J: Floats
    """(6N,)."""
    H: Floats
    """(6N, 6N), symmetric, not definite: a common motion of all frames costs nothing."""


def retract(T_world_camera: Floats, step: Floats) -> Floats:
    """Move poses (N, 4, 4) by steps (N, 6), [w, d] in rad and m, about the world's origin."""
    return np.asarray(se3.make(se3.exp_so3(step[:, :3]), step[:, 3:]) @ T_world_camera)


def cost(planes: Planes, T_world_camera: Floats) -> float:
    """Return Σ N λ_min, m², with the frames (N, 4, 4) there."""
    whole = join_clusters(
        move_clusters(T_world_camera[planes.frame], planes.clusters), planes.feature, len(planes)
    )
    values = np.linalg.eigvalsh(covariances(whole)[1])
    return float(whole[:, 3, 3] @ values[:, 0])


def linearise(planes: Planes, T_world_camera: Floats) -> Quadratic:
    """Return the cost to second order about the poses (N, 4, 4)."""
    C = move_clusters(T_world_camera[planes.frame], planes.clusters)
    whole = join_clusters(C, planes.feature, len(planes))
    m, covariance = covariances(whole)
    N = whole[:, 3, 3]
    values, axes = np.linalg.eigh(covariance)

    own = planes.feature
    u = axes[own, :, 0]
    n, m = C[:, 3, 3], m[own]
    s = C[:, :3, 3] - n[:, None] * m  # Σ r
    m_s = m[:, :, None] * s[:, None, :]
    m_m = n[:, None, None] * m[:, :, None] * m[:, None, :]
    m_sum = m[:, :, None] * C[:, None, :3, 3]
    S = C[:, :3, :3] - m_sum - np.swapaxes(m_sum, 1, 2) + m_m  # Σ r rᵀ

    def along(axis: Floats) -> tuple[Floats, Floats]:
        """Σ (axis.r) q (k, 3) and Σ axis.r (k,)."""
        total = _dot(axis, s)
        return m * total[:, None] + np.einsum("kij,kj->ki", S, axis), total

    eq, e = along(u)
    J_rows = 2.0 * np.concatenate([np.cross(eq, u), e[:, None] * u], axis=1)

    # the frame's own block
    sum_q = n[:, None] * m + s
    Q = m_m + m_s + np.swapaxes(m_s, 1, 2) + S  # Σ q qᵀ
    K = se3.hat(u)
    D = np.zeros((len(C), 6, 6))
    eq_u = eq[:, :, None] * u[:, None, :]
    D[:, :3, :3] = 2.0 * (K @ Q @ np.swapaxes(K, 1, 2) - _dot(u, eq)[:, None, None] * np.eye(3))
    D[:, :3, :3] += eq_u + np.swapaxes(eq_u, 1, 2)
    D[:, :3, 3:] = 2.0 * np.cross(sum_q, u)[:, :, None] * u[:, None, :]
    D[:, 3:, :3] = np.swapaxes(D[:, :3, 3:], 1, 2)
    D[:, 3:, 3:] = 2.0 * n[:, None, None] * u[:, :, None] * u[:, None, :]

    # what couples the frames of a plane: three products of a column with itself
    columns = np.empty((len(C), 3, 6))
    weights = np.empty((len(planes), 3))
    columns[:, 0, :3], columns[:, 0, 3:] = np.cross(sum_q, u), n[:, None] * u
    weights[:, 0] = -2.0 / N
    for k in (1, 2):
        other = axes[own, :, k]
        lq, length = along(other)
        columns[:, k, :3] = np.cross(lq, u) + np.cross(eq, other)
        columns[:, k, 3:] = length[:, None] * u + e[:, None] * other
        gap = values[:, 0] - values[:, k]
        # points on a line have no normal that could turn
        weights[:, k] = np.divide(2.0, N * gap, out=np.zeros_like(N), where=gap < 0)

    J = np.zeros((planes.frames, 6))
    np.add.at(J, planes.frame, J_rows)
    H = np.zeros((6 * planes.frames, 6 * planes.frames))
    _assemble(planes.first, planes.frame, D, columns, weights, H)
    return Quadratic(float(N @ values[:, 0]), J.ravel(), H + np.tril(H, -1).T)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.einsum("ki,ki->k", a, b))


@nb.njit(cache=True, nogil=True)
def _assemble(first, frame, D, columns, weights, H):
    """Add blocks and products to the lower triangle of H; a plane's frames rise."""
    for f in range(first.shape[0] - 1):
        for row in range(first[f], first[f + 1]):
            a = 6 * frame[row]
            for i in range(6):
                for j in range(i + 1):
                    H[a + i, a + j] += D[row, i, j]
            for k in range(3):
                for i in range(6):
                    scaled = weights[f, k] * columns[row, k, i]
                    for other in range(first[f], row):
                        b = 6 * frame[other]
                        for j in range(6):
                            H[a + i, b + j] += scaled * columns[other, k, j]
                    for j in range(i + 1):
                        H[a + i, a + j] += scaled * columns[row, k, j]
