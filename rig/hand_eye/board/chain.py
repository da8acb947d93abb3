"""From X to pixels: what a calibration with a board predicts, with all derivatives.

``T_camera_board(i) = X^-1 G(i) Y``, G being the flange pose or its inverse (`Observations.carrier`)
after the flange has been put right: by what this pose missed, by the joints' zeros, and by how far
the flange went on between the robot's stamp and the camera's. Poses are perturbed as in
`depthba.se3.retract`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import Camera
from rig.hand_eye.board import lens
from rig.hand_eye.board.observations import Observations

Array = NDArray[np.float64]

X, Y, LENS, SIZE, CLOCK, ZEROS = slice(0, 6), slice(6, 12), slice(12, 21), 21, 22, 23
"""Where X, Y, the lens, the board's size, the clock and, from 23 on, the joints' zeros stand among
what all poses share."""


@dataclass(frozen=True, eq=False)
class Chain:
    """The unknowns."""

    X: Array
    """(4, 4), T_flange_camera; eye-to-hand: T_base_camera."""
    Y: Array
    """(4, 4), T_base_board; eye-to-hand: T_flange_board."""
    missed: Array
    """(N, 6), by which each flange is elsewhere than its joints say, base axes, m and rad."""
    lens: Array
    """(9,), by which the camera is off, as `lens.NAMES` has it."""
    size: float
    """Log of how much larger the board is than stated."""
    clock: float
    """s, by which the camera's stamps are late."""
    zeros: Array
    """(n,), by which the joints' zeros are off, rad."""

    @property
    def shared(self) -> int:
        """How many numbers all poses share."""
        return ZEROS + len(self.zeros)

    def moved(self, step: Array, missed: Array) -> Chain:
        """Return the chain after a step of what is shared (s,) and of each flange (N, 6)."""
        return replace(
            self,
            X=se3.retract(self.X, step[X]),
            Y=se3.retract(self.Y, step[Y]),
            lens=self.lens + step[LENS],
            size=self.size + float(step[SIZE]),
            clock=self.clock + float(step[CLOCK]),
            zeros=self.zeros + step[ZEROS:],
            missed=self.missed + missed,
        )

    def values(self) -> Array:
        """(s,), what is shared as departures from what is believed; X is believed near its frame.

        0 for X's rotation and for Y, of which nothing is believed.
        """
        place = np.concatenate([self.X[:3, 3], np.zeros(9)])
        return np.concatenate([place, self.lens, [self.size, self.clock], self.zeros])

    def camera(self, observations: Observations) -> Camera:
        """Return the camera as it is thought to be."""
        return lens.changed(observations.camera, self.lens)

    def off(self, observations: Observations, velocity: Array) -> Array:
        """(N, 6), by which each flange is thought to be elsewhere than reported, m and rad."""
        off = self.missed + velocity * self.clock
        if observations.joints is not None:
            off = off + observations.joints @ self.zeros
        return np.asarray(off)

    def T_camera_board(self, observations: Observations, velocity: Array) -> Array:
        """(N, 4, 4), where the cameras have the board."""
        T = se3.retract(observations.T_base_flange, self.off(observations, velocity))
        G = se3.inverse(T) if observations.mount == "eye-in-hand" else T
        return np.asarray(se3.inverse(self.X) @ G @ self.Y)


def left_jacobian(phi: Array) -> Array:
    """Return J (..., 3, 3) with ``Exp(phi + d) = Exp(J d) Exp(phi)`` to first order in d."""
    angle2 = np.square(phi).sum(axis=-1)[..., None, None]
    K = se3.hat(phi)
    small = angle2 < 1e-6
    safe = np.where(small, 1.0, angle2)
    angle = np.sqrt(safe)
    a = np.where(small, 0.5 - angle2 / 24, (1 - np.cos(angle)) / safe)
    b = np.where(small, 1 / 6 - angle2 / 120, (angle - np.sin(angle)) / (safe * angle))
    return np.asarray(np.eye(3) + a * K + b * (K @ K))


def errors(chain: Chain, observations: Observations, velocity: Array) -> Array:
    """Return predicted less found pixels (N, M, 2); NaN where a point was not found."""
    T = chain.T_camera_board(observations, velocity)
    points = np.exp(chain.size) * observations.points
    camera = np.einsum("nij,mj->nmi", T[:, :3, :3], points) + T[:, None, :3, 3]
    return np.asarray(lens.project(camera, chain.camera(observations))[0] - observations.pixels)


def linearise(
    chain: Chain, observations: Observations, velocity: Array
) -> tuple[Array, Array, Array]:
    """Return the errors and their derivatives.

    Args:
        chain: where.
        observations: N poses, M points.
        velocity: (N, 6), of the flanges, m/s and rad/s, base axes.

    Returns:
        Predicted less found pixels (N, M, 2), their derivatives by what is shared (N, M, 2, s) and
        by what each flange missed (N, M, 2, 6); NaN where a point was not found.
    """
    off = chain.off(observations, velocity)
    T = se3.retract(observations.T_base_flange, off)
    R_T, t_T = T[:, None, :3, :3], T[:, None, :3, 3]
    R_X, t_X, R_Y, t_Y = chain.X[:3, :3], chain.X[:3, 3], chain.Y[:3, :3], chain.Y[:3, 3]
    arm = np.exp(chain.size) * observations.points @ R_Y.T
    in_Y = arm + t_Y
    turn = left_jacobian(off[:, 3:])[:, None]
    # the point in the frame that X hangs on, and its derivatives by Y's frame and by the flange
    if observations.mount == "eye-in-hand":
        away = in_Y - t_T
        R_G = np.swapaxes(R_T, -1, -2)
        in_X = (R_G @ away[..., None])[..., 0]
        by_flange = np.concatenate(
            [np.broadcast_to(-R_G, (*away.shape, 3)), R_G @ se3.hat(away) @ turn], axis=-1
        )
    else:
        R_G = R_T
        swung = (R_T @ in_Y[..., None])[..., 0]
        in_X = swung + t_T
        along = np.broadcast_to(np.eye(3), (*swung.shape, 3))
        by_flange = np.concatenate([along, -se3.hat(swung) @ turn], axis=-1)
    by_Y = R_G @ np.concatenate(
        [np.broadcast_to(np.eye(3), (*arm.shape, 3)), -se3.hat(arm)], axis=-1
    )
    by_size = (R_G @ arm[..., None])[..., 0]
    by_X = np.concatenate(
        [np.broadcast_to(-np.eye(3), (*in_X.shape, 3)), se3.hat(in_X - t_X)], axis=-1
    )
    pixels, by_point, by_lens = lens.project((in_X - t_X) @ R_X, chain.camera(observations))
    to_pixel = by_point @ R_X.T
    J_pose = to_pixel @ by_flange
    J = np.empty((*pixels.shape, chain.shared))
    J[..., X], J[..., Y], J[..., LENS] = to_pixel @ by_X, to_pixel @ by_Y, by_lens
    J[..., SIZE] = (to_pixel @ by_size[..., None])[..., 0]
    # the rotation part of J_pose holds the left Jacobian: these add to the flange's own
    J[..., CLOCK] = np.einsum("nmik,nk->nmi", J_pose, velocity)
    if observations.joints is not None:
        J[..., ZEROS:] = J_pose @ observations.joints[:, None]
    return pixels - observations.pixels, J, J_pose
