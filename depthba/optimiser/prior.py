"""The measured poses as residuals, so that what the data leave open is held by what is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3


@dataclass(frozen=True)
class PosePrior:
    """Gaussian priors on the poses.

    The error is ``[t - t_measured, log(R R_measured^T)]``, map axes.
    """

    T_map_camera: NDArray[np.float64]
    """(N, 4, 4), measured."""
    information: NDArray[np.float64]
    """(N, 6, 6), inverse covariance; zero where nothing is believed."""

    def cost(self, T_map_camera: NDArray[np.float64]) -> float:
        """Return the sum of squared normalised errors."""
        e = se3.difference(T_map_camera, self.T_map_camera)
        return float(np.einsum("ni,nij,nj->", e, self.information, e))

    def normal_equations(
        self, T_map_camera: NDArray[np.float64], pivots: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the matrix (N, 6, 6) and gradient (N, 6) in perturbations about the pivots (N, 3).

        The derivative of the rotation's logarithm is taken as the identity: its error is of second
        order in an angle that is small wherever the prior matters.
        """
        J = about_pivot(T_map_camera, pivots)
        e = se3.difference(T_map_camera, self.T_map_camera)
        weighted = np.einsum("nji,njk->nik", J, self.information)
        return weighted @ J, np.einsum("nij,nj->ni", weighted, e)


def pose_prior(
    T_map_camera: NDArray[np.float64],
    R_map_world: NDArray[np.float64],
    sigma_t: NDArray[np.float64],
    sigma_r: NDArray[np.float64],
    fixed: NDArray[np.bool_],
) -> PosePrior:
    """Build a prior from standard deviations along the world axes.

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
    return PosePrior(T_map_camera, information)


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
