"""The measured poses as residuals, so that what the data leave open is held by what is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from depthba import se3
from depthba.optimiser.asking import look

# Rounds in which the gauge is found: it is next to linear.
ROUNDS = 3


@dataclass(frozen=True)
class PosePrior:
    """Gaussian priors on the poses.

    The error of a pose is ``[t - t_measured, log(R R_measured^T)]``, map axes. The map hangs on
    frame 0 as it was measured, whose own error all other frames share: a degree in frame 0 shifts a
    frame five metres away by nine centimetres. So the errors are taken after the rigid motion, the
    *gauge*, that makes the cost least; it pays as frame 0's error.

    Poses of a camera on a robot also share what is wrong with its hand-eye transform: one motion in
    the camera's axes, after each measured pose. It is found with the gauge, and pays likewise.
    """

    T_map_camera: NDArray[np.float64]
    """(N, 4, 4), measured."""
    information: NDArray[np.float64]
    """(N, 6, 6), inverse covariance; zero where nothing is believed, and of frames that do not
    move."""
    gauge: NDArray[np.float64] | None = None
    """(6, 6), inverse covariance of frame 0's own error; None: it has none."""
    hand_eye: NDArray[np.float64] | None = None
    """(6, 6), inverse covariance of the hand-eye transform's error, camera axes; None: it has none,
    as where frame 0 has none."""

    @property
    def shared(self) -> bool:
        """Whether frame 0's own error is found."""
        return self.gauge is not None and bool(self.information.any())

    def at(self, T_map_camera: NDArray[np.float64]) -> PriorAt:
        """Return where poses (N, 4, 4) stand: the errors that cost least."""
        if self.gauge is None or not self.shared:
            K = np.zeros((len(T_map_camera), 6, 6))
            e = se3.difference(T_map_camera, self.T_map_camera)
            return PriorAt(self, T_map_camera, e, np.eye(3), K, 0.0)
        G, x = np.eye(4)[None], np.zeros(6)
        for k in range(ROUNDS + 1):
            measured = self.T_map_camera @ se3.make(se3.exp_so3(x[3:]), x[:3])
            moved = G @ np.concatenate([self.T_map_camera[:1], T_map_camera])
            errors = se3.difference(moved, np.concatenate([measured[:1], measured]))
            own, e = errors[0], errors[1:]
            if k == ROUNDS:
                break
            centre = moved[:1, :3, 3]
            K = about_pivot(moved[1:], centre)
            if self.hand_eye is not None:
                K = np.concatenate([K, -_in_map(self.T_map_camera)], axis=2)
            b = np.einsum("nki,nk->i", self.information @ K, e)
            b += self._of_first(K).T @ self.gauge @ own
            if self.hand_eye is not None:
                b[6:] += self.hand_eye @ x
            step = -self.inverse(K) @ b
            G = move(G, centre, step[None, :6])
            if self.hand_eye is not None:
                x = x + step[6:]
        paid = float(own @ self.gauge @ own)
        if self.hand_eye is not None:
            paid += float(x @ self.hand_eye @ x)
        return PriorAt(self, T_map_camera, e, G[0, :3, :3], K, paid)

    def _of_first(self, K: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (6, m), the derivative of frame 0's own error."""
        return np.concatenate([np.eye(6), K[0, :, 6:]], axis=1)

    def inverse(self, K: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the inverse (m, m) of what holds the motions that all frames share."""
        first = self._of_first(K)
        assert self.gauge is not None  # else nothing is shared
        H = first.T @ self.gauge @ first + np.einsum("nki,nkl->il", K, self.information @ K)
        if self.hand_eye is not None:
            H[6:, 6:] += self.hand_eye
        own = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        return np.asarray(np.linalg.pinv(H * np.outer(own, own), hermitian=True)) * np.outer(
            own, own
        )


@dataclass(frozen=True)
class PriorAt:
    """A prior at some poses."""

    prior: PosePrior
    T_map_camera: NDArray[np.float64]
    """(N, 4, 4)."""
    errors: NDArray[np.float64]
    """(N, 6)."""
    turn: NDArray[np.float64]
    """(3, 3), the gauge's rotation."""
    K: NDArray[np.float64]
    """(N, 6, m), Jacobians by what all frames share: the gauge (6), then the hand-eye error (6) if
    there is one."""
    paid: float
    """For what all frames share."""

    @property
    def distances(self) -> NDArray[np.float64]:
        """(N,) by how many stated deviations each pose is off, over all six directions."""
        e = self.errors
        return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", e, self.prior.information, e)))

    @property
    def cost(self) -> float:
        """The sum of squared normalised errors, the gauge's own included."""
        e = self.errors
        return self.paid + float(np.einsum("ni,nij,nj->", e, self.prior.information, e))

    def normal_equations(
        self, pivots: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the matrix (6N, 6N) and gradient (N, 6) in perturbations about the pivots (N, 3).

        The gauge is eliminated. The derivative of the rotation's logarithm is taken as the
        identity: its error is of second order in an angle that is small wherever the prior matters.
        """
        J = np.kron(np.eye(2), self.turn) @ about_pivot(self.T_map_camera, pivots)
        weighted = np.einsum("nji,njk->nik", J, self.prior.information)
        look()
        matrix = block_diag(*(weighted @ J))
        if self.prior.shared:
            U = (weighted @ self.K).reshape(matrix.shape[0], -1)
            look()
            matrix -= U @ self.prior.inverse(self.K) @ U.T
        return matrix, np.einsum("nij,nj->ni", weighted, self.errors)


def pose_prior(
    T_map_camera: NDArray[np.float64],
    R_map_world: NDArray[np.float64],
    sigma_t: NDArray[np.float64],
    sigma_r: NDArray[np.float64],
    fixed: NDArray[np.bool_],
    hand_eye: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> PosePrior:
    """Build a prior from standard deviations along the world axes, frame 0's among them.

    Args:
        T_map_camera: (N, 4, 4) measured.
        R_map_world: (3, 3).
        sigma_t: (3,) m; infinity believes nothing.
        sigma_r: (3,) rad, likewise.
        fixed: (N,) frames that do not move and need none.
        hand_eye: standard deviations (3,) m and (3,) rad of the hand-eye transform, camera axes;
            None: it has no error that the poses do not state each for itself.
    """
    one = np.zeros((6, 6))
    one[:3, :3] = R_map_world @ np.diag(1.0 / np.square(sigma_t)) @ R_map_world.T
    one[3:, 3:] = R_map_world @ np.diag(1.0 / np.square(sigma_r)) @ R_map_world.T
    information = np.repeat(one[None], len(T_map_camera), axis=0)
    information[fixed] = 0.0
    shared = None if hand_eye is None else np.diag(1.0 / np.square(np.concatenate(hand_eye)))
    return PosePrior(T_map_camera, information, one, shared)


def _in_map(T_map_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 6, 6) that turn a shift and a turn in the axes of each camera into the map's."""
    out = np.zeros((len(T_map_camera), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = T_map_camera[:, :3, :3]
    return out


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
