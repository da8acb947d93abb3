"""The chain from the world to the camera, ``T_world_camera(i) = T_world_base T_base_flange(i) X``.

Perturbations of ``X = T_flange_camera`` and of the flange poses are as in `depthba.se3.retract`:
translation then rotation, the former about the camera centre along the flange's axes, the latter
about the flange's origin along the base's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from depthba import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Chain:
    """Where every camera is, by the robot and the hand-eye transform."""

    T_world_base: Array
    """(4, 4): the gauge, of which depths say nothing."""
    T_base_flange: Array
    """(N, 4, 4), as the robot reports them."""
    T_flange_camera: Array
    """(4, 4), X."""
    missed: Array
    """(N, 6), by which each flange is elsewhere than its joints say, m and rad."""
    joints: Array
    """(6N, n), the flanges' motion with the joints' zeros, m and rad per rad; n is 0 where the arm
    is not known."""
    zeros: Array
    """(n,), by which the joints' zeros are off, rad."""

    @property
    def T_base_flange_corrected(self) -> Array:
        """(N, 4, 4), where the flanges are thought to be."""
        off = self.missed + (self.joints @ self.zeros).reshape(-1, 6)
        return se3.retract(self.T_base_flange, off)

    @property
    def T_world_flange(self) -> Array:
        """(N, 4, 4), corrected."""
        return np.asarray(self.T_world_base @ self.T_base_flange_corrected)

    @property
    def T_world_camera(self) -> Array:
        """(N, 4, 4), corrected."""
        return np.asarray(self.T_world_flange @ self.T_flange_camera)

    def moved(self, step: NDArray[np.floating[Any]]) -> Chain:
        """Return the chain after a step of X (6,), or of X, the zeros and the flanges.

        The step (6 + n + 6N,) is in that order.
        """
        chain = replace(self, T_flange_camera=se3.retract(self.T_flange_camera, step[:6]))
        if len(step) == 6:
            return chain
        n = len(self.zeros)
        missed = self.missed + step[6 + n :].reshape(-1, 6)
        return replace(chain, zeros=self.zeros + step[6 : 6 + n], missed=missed)

    def jacobian(self) -> Array:
        """Return (6N, 6 + n + 6N): what `moved` takes, as perturbations of the cameras.

        Those are as `depthba.se3.retract` has them: about the camera centres, world axes.
        """
        robot = self.by_robot()
        return np.hstack([self.by_hand_eye(), robot @ self.joints, robot])

    def by_hand_eye(self) -> Array:
        """Return (6N, 6): a perturbation of X as perturbations of all cameras.

        With ``G = T_world_flange``, ``R_G Exp(phi) R_X = Exp(R_G phi) R_G R_X`` and
        ``R_G (t_X + tau) + t_G``: both parts only turn into world axes.
        """
        T_world_flange = self.T_world_flange
        turn = np.zeros((len(T_world_flange), 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = T_world_flange[:, :3, :3]
        return turn.reshape(-1, 6)

    def by_robot(self) -> Array:
        """Return (6N, 6N), block-diagonal: the same for a perturbation of each flange.

        A turn of the flange swings the camera about it.
        """
        R_world_base = self.T_world_base[:3, :3]
        flange = self.T_base_flange_corrected
        swing = -se3.hat(flange[:, :3, :3] @ self.T_flange_camera[:3, 3])
        turn = np.zeros((len(flange), 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = R_world_base
        turn[:, :3, 3:] = R_world_base @ swing
        return np.asarray(block_diag(*turn))
