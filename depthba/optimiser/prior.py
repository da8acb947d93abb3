"""The measured poses as residuals, so that what the data leave open is held by what is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from depthba import se3

# Rounds in which the gauge is found: it is next to linear.
ROUNDS = 3


@dataclass(frozen=True)
class PosePrior:
    """Gaussian priors on the poses.

    The error of a pose is ``[t - t_measured, log(R R_measured^T)]``, map axes. The map hangs on
    frame 0 as it was measured, whose own error all other frames share: a degree in frame 0 shifts a
    frame five metres away by nine centimetres. So the errors are taken after the rigid motion, the
    *gauge*, that makes the cost least; it pays as frame 0's error.
    """

    T_map_camera: NDArray[np.float64]
    """(N, 4, 4), measured."""
    information: NDArray[np.float64]
    """(N, 6, 6), inverse covariance; zero where nothing is believed, and of frames that do not
    move."""
    gauge: NDArray[np.float64] | None = None
    """(6, 6), inverse covariance of frame 0's own error; None: it has none."""

    def distances(self, T_map_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N,) by how many stated deviations each pose is off, over all six directions."""
        e = self._errors(T_map_camera)[0]
        return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", e, self.information, e)))

    def cost(self, T_map_camera: NDArray[np.float64]) -> float:
        """Return the sum of squared normalised errors, the gauge's own included."""
        e, _, _, paid = self._errors(T_map_camera)
        return paid + float(np.einsum("ni,nij,nj->", e, self.information, e))

    def normal_equations(
        self, T_map_camera: NDArray[np.float64], pivots: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the matrix (6N, 6N) and gradient (N, 6) in perturbations about the pivots (N, 3).

        The gauge is eliminated. The derivative of the rotation's logarithm is taken as the
        identity: its error is of second order in an angle that is small wherever the prior matters.
        """
        e, turn, K, _ = self._errors(T_map_camera)
        J = np.kron(np.eye(2), turn) @ about_pivot(T_map_camera, pivots)
        weighted = np.einsum("nji,njk->nik", J, self.information)
        matrix = block_diag(*(weighted @ J))
        if self.gauge is not None and self.information.any():
            U = (weighted @ K).reshape(-1, 6)
            matrix -= U @ self._inverse(K) @ U.T
        return matrix, np.einsum("nij,nj->ni", weighted, e)

    def _errors(
        self, T_map_camera: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
        """Return the errors (N, 6), the gauge's rotation, its Jacobians (N, 6, 6) and its cost."""
        centre = self.T_map_camera[:1, :3, 3]
        G = np.eye(4)[None]
        K = about_pivot(T_map_camera, centre)
        if self.gauge is None or not self.information.any():
            return se3.difference(T_map_camera, self.T_map_camera), np.eye(3), K, 0.0
        for _ in range(ROUNDS):
            moved, own = self._moved(T_map_camera, G)
            K = about_pivot(moved, centre + own[:3])
            e = se3.difference(moved, self.T_map_camera)
            b = self.gauge @ own + np.einsum("nji,njk,nk->i", K, self.information, e)
            G = move(G, centre + own[:3], -(self._inverse(K) @ b)[None])
        moved, own = self._moved(T_map_camera, G)
        e = se3.difference(moved, self.T_map_camera)
        return e, G[0, :3, :3], K, float(own @ self.gauge @ own)

    def _moved(
        self, T_map_camera: NDArray[np.float64], G: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the poses under the gauge (1, 4, 4), and what it does to frame 0 (6,)."""
        first = self.T_map_camera[:1]
        return G @ T_map_camera, se3.difference(G @ first, first)[0]

    def _inverse(self, K: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the inverse (6, 6) of what holds the gauge."""
        H = self.gauge + np.einsum("nji,njk,nkl->il", K, self.information, K)
        own = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        return np.asarray(np.linalg.pinv(H * np.outer(own, own), hermitian=True)) * np.outer(
            own, own
        )


def pose_prior(
    T_map_camera: NDArray[np.float64],
    R_map_world: NDArray[np.float64],
    sigma_t: NDArray[np.float64],
    sigma_r: NDArray[np.float64],
    fixed: NDArray[np.bool_],
) -> PosePrior:
    """Build a prior from standard deviations along the world axes, frame 0's among them.

    Args:
        T_map_camera: (N, 4, 4) measured.
        R_map_world: (3, 3).
        sigma_t: (3,) m; infinity believes nothing.
        sigma_r: (3,) rad, likewise.
        fixed: (N,) frames that do not move and need none.
    """
    one = np.zeros((6, 6))
    one[:3, :3] = R_map_world @ np.diag(1.0 / np.square(sigma_t)) @ R_map_world.T
    one[3:, 3:] = R_map_world @ np.diag(1.0 / np.square(sigma_r)) @ R_map_world.T
    information = np.repeat(one[None], len(T_map_camera), axis=0)
    information[fixed] = 0.0
    return PosePrior(T_map_camera, information, one)


def about_pivot(
    T_map_camera: NDArray[np.float64], pivots: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (N, 6, 6) that take a perturbation about the pivot to one about the camera centre."""
    J = np.repeat(np.eye(6)[None], len(T_map_camera), axis=0)
    J[:, :3, 3:] = -se3.hat(T_map_camera[:, :3, 3] - pivots)
    return J


def move(
    T_map_camera: NDArray[np.float64], pivots: NDArray[np.float64], pose: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Apply perturbations (N, 6) about the pivots: ``q <- Exp(phi) (q - c) + c + tau``."""
    turn = se3.exp_so3(pose[:, 3:])
    arm = T_map_camera[:, :3, 3] - pivots
    t = np.einsum("nij,nj->ni", turn, arm) + pivots + pose[:, :3]
    return se3.make(turn @ T_map_camera[:, :3, :3], t)
