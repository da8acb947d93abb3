"""AX = XB in closed form (Park & Martin 1994), over all pairs of poses, each with its weight.

``A_ij X = X B_ij`` with ``A_ij = G_i G_j^-1`` and ``B_ij = P_i P_j^-1`` for ``P_i = X^-1 G_i Y``:
P is T_camera_board; G as `Observations.carrier` gives it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Closer to half a turn than this, rad, a rotation vector may jump to its opposite.
HALF_TURN = 0.05
# Rounds in which pairs are weighed anew, and beyond how many typical errors a pair loses weight.
ROUNDS = 20
TUNING = 3.0


@dataclass(frozen=True)
class Motions:
    """Pairs of poses and what happened between them."""

    i: Indices
    j: Indices
    A: Array
    """(K, 4, 4), of the robot."""
    B: Array
    """(K, 4, 4), of the camera."""

    @property
    def alpha(self) -> Array:
        """(K, 3), rad, rotation vectors of A."""
        return se3.log_so3(self.A[:, :3, :3])

    @property
    def beta(self) -> Array:
        """(K, 3), rad, rotation vectors of B."""
        return se3.log_so3(self.B[:, :3, :3])


def motions(G: Array, P: Array, pairs: tuple[Indices, Indices] | None = None) -> Motions:
    """Return the motions between poses (N, 4, 4), of all pairs, later to earlier, or of these."""
    j, i = np.triu_indices(len(G), 1) if pairs is None else pairs[::-1]
    return Motions(i, j, G[i] @ se3.inverse(G[j]), P[i] @ se3.inverse(P[j]))


def solve_rotation(alpha: Array, beta: Array, weights: Array | None = None) -> Array:
    """Return R_X (3, 3) that takes the camera's turns beta (K, 3) to the robot's alpha (K, 3).

    ``(M^T M)^(-1/2) M^T`` with ``M = sum w beta alpha^T`` (their eq. 27): the orthogonal factor of
    M^T, taken from its singular value decomposition so that turns about two axes will do.
    """
    w = np.ones(len(alpha)) if weights is None else weights
    u, _, vt = np.linalg.svd((w[:, None] * alpha).T @ beta)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def solve_translation(
    A: Array, B: Array, R: Array, weights: Array | None = None, scale: bool = False
) -> tuple[Array, float]:
    """Return t_X (3,), m, and how large the camera's unit of length is, m.

    Least squares over ``(R_A - I) t_X - s R_X t_B = -t_A``, s = 1 unless asked for (Andreff 1999).
    Of a direction that no turn shows, the shortest answer is taken.
    """
    w = np.ones(len(A)) if weights is None else np.sqrt(weights)
    left = A[:, :3, :3] - np.eye(3)
    seen = B[:, :3, 3] @ R.T
    if scale:
        matrix = np.concatenate([left, -seen[..., None]], axis=-1)
        right = -A[:, :3, 3]
    else:
        matrix, right = left, seen - A[:, :3, 3]
    size = matrix.shape[-1]
    found = np.linalg.lstsq(
        (w[:, None, None] * matrix).reshape(-1, size), (w[:, None] * right).ravel(), rcond=1e-9
    )[0]
    return found[:3], float(found[3]) if scale else 1.0


def park_martin(m: Motions) -> Array:
    """Return X (4, 4), every pair of the same weight, as in the paper."""
    R = solve_rotation(m.alpha, m.beta)
    return se3.make(R, solve_translation(m.A, m.B, R)[0])


def solve(m: Motions) -> Array:
    """Return X (4, 4), each pair weighed by how well it fits and how sharply it speaks.

    Rotations of pairs err alike, whatever the angle. The error of a translation equation grows with
    the lever ``|t_B|`` on which the camera's turn swings the board, so its variance is modelled as
    ``a + b |t_B|^2`` with the shares that the residuals show. Pairs that fit far worse than the
    typical one lose their weight (Geman & McClure 1987), begun from the angles alone, which must
    agree whatever X is.
    """
    alpha, beta = m.alpha, m.beta
    usable = np.linalg.norm(alpha, axis=1) < np.pi - HALF_TURN
    usable &= np.linalg.norm(beta, axis=1) < np.pi - HALF_TURN
    if usable.sum() < 2:
        usable[:] = True
    mismatch = np.abs(np.linalg.norm(alpha, axis=1) - np.linalg.norm(beta, axis=1))
    w = usable * _kept(mismatch, usable)
    R = solve_rotation(alpha, beta, w)
    for _ in range(ROUNDS):
        w = usable * _kept(np.linalg.norm(alpha - beta @ R.T, axis=1), usable)
        R = solve_rotation(alpha, beta, w)
    lever = np.square(m.B[:, :3, 3]).sum(axis=1)
    variance = np.ones(len(lever))
    t, _ = solve_translation(m.A, m.B, R, w)
    for _ in range(ROUNDS):
        misfit = np.einsum("kij,j->ki", m.A[:, :3, :3] - np.eye(3), t)
        misfit -= m.B[:, :3, 3] @ R.T - m.A[:, :3, 3]
        square = np.square(misfit).sum(axis=1)
        fit = _kept(np.sqrt(square / variance), usable)
        variance = _variance(square, lever, usable * fit)
        t, _ = solve_translation(m.A, m.B, R, usable * fit / variance)
    return se3.make(R, t)


def _kept(error: Array, usable: NDArray[np.bool_]) -> Array:
    """Weights (K,) of errors (K,): 1 where they are small beside the typical one."""
    typical = float(np.median(error[usable]))
    return np.asarray(1.0 / (1.0 + (error / max(TUNING * typical, 1e-12)) ** 2) ** 2)


def _variance(square: Array, lever: Array, w: Array) -> Array:
    """Variances (K,), up to a factor, as ``a + b lever`` fits the squared residuals, a, b >= 0."""
    if lever.max() < 1e-12:
        return np.ones(len(square))
    basis = np.stack([np.ones(len(lever)), lever / lever.max()], axis=1)
    a, b = np.linalg.lstsq(w[:, None] * basis, w * square, rcond=None)[0]
    if a < 0 or b < 0:
        a, b = (0.05, 1.0) if a < 0 else (1.0, 0.0)
    total = basis @ [a, b]
    return np.asarray(total / max(float(np.median(total)), 1e-300))


def board_poses(G: Array, P: Array, X: Array) -> Array:
    """Return Y (N, 4, 4) as each pose has it, ``G^-1 X P``: all alike but for noise."""
    return np.asarray(se3.inverse(G) @ X @ P)


def mean_pose(T: Array, weights: Array | None = None) -> Array:
    """Return the mean (4, 4) of poses (N, 4, 4): of the places, and of the rotations (chordal)."""
    w = np.ones(len(T)) if weights is None else weights
    u, _, vt = np.linalg.svd(np.einsum("n,nij->ij", w, T[:, :3, :3]))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return se3.make(R, w @ T[:, :3, 3] / w.sum())
