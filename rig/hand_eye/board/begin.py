"""Where the refinement starts: closed form, with poses that do not fit set aside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from rig.hand_eye.board import park_martin
from rig.hand_eye.flanges import STILL

Array = NDArray[np.float64]

ROUNDS = 10
# A pose is set aside when it closes this many times worse than the typical one.
APART = 6.0
# Nothing closes better than this, m and rad.
LEAST_T, LEAST_R = 1e-5, 1e-5
# Rotations tried about the one axis of all turns.
TRIES = 90


@dataclass(frozen=True, eq=False)
class Beginning:
    """A first X and Y."""

    X: Array
    """(4, 4)."""
    Y: Array
    """(4, 4)."""
    closure: Array
    """(N, 6), by which each pose has Y elsewhere, in Y's frame's parent's axes, m and rad."""
    good: NDArray[np.bool_]
    """(N,), the poses that were believed."""

    @property
    def typical(self) -> tuple[float, float]:
        """Median size of the closures, m and rad."""
        size = sizes(self.closure)
        return float(np.median(size[:, 0])), float(np.median(size[:, 1]))


def closed_form(m: park_martin.Motions) -> Array:
    """Return X (4, 4), also where the turns leave its rotation open and shifts fix it.

    Without turns ``t_A = R_X t_B``. With turns about one axis alone, the rotation about that axis
    is tried all round, and the one kept with which the translations close best.
    """
    values, axes = np.linalg.eigh(m.alpha.T @ m.alpha / max(len(m.alpha), 1))
    size = np.sqrt(np.maximum(values[::-1], 0.0))
    if size[0] < STILL:
        R = park_martin.solve_rotation(m.A[:, :3, 3], m.B[:, :3, 3])
        return se3.make(R, np.zeros(3))
    if size[1] >= STILL:
        return park_martin.solve(m)
    first = park_martin.solve_rotation(m.alpha, m.beta)
    best, found = np.inf, se3.make(first, np.zeros(3))
    for turn in np.linspace(0, 2 * np.pi, TRIES, endpoint=False):
        R = se3.exp_so3(turn * axes[:, 2]) @ first
        t, _ = park_martin.solve_translation(m.A, m.B, R)
        misfit = (m.A[:, :3, :3] - np.eye(3)) @ t - m.B[:, :3, 3] @ R.T + m.A[:, :3, 3]
        square = float(np.square(misfit).sum())
        if square < best:
            best, found = square, se3.make(R, t)
    return found


def sizes(delta: Array) -> Array:
    """(N, 2), m and rad, of perturbations (N, 6)."""
    return np.stack(
        [np.linalg.norm(delta[:, :3], axis=1), np.linalg.norm(delta[:, 3:], axis=1)], axis=1
    )


def begin(G: Array, P: Array) -> Beginning:
    """Find X and Y from poses (N, 4, 4) that may hold some bad ones.

    Args:
        G: `Observations.carrier`.
        P: T_camera_board.
    """
    good = agreeing(G, P)
    for _ in range(ROUNDS):
        X = closed_form(park_martin.motions(G[good], P[good]))
        each = park_martin.board_poses(G, P, X)
        Y = park_martin.mean_pose(each[good])
        closure = se3.difference(each, Y)
        size = sizes(closure)
        typical = np.maximum(np.median(size[good], axis=0), [LEAST_T, LEAST_R])
        better = np.asarray((size < APART * typical).all(axis=1))
        if better.sum() < max(3, len(G) // 2) or (better == good).all():
            break
        good = better
    return Beginning(X, Y, closure, good)


def agreeing(G: Array, P: Array) -> NDArray[np.bool_]:
    """Return which poses (N,) turned by the same angles as seen by the robot and by the camera.

    Angles of motions agree whatever X is. A pose's misfit is the median over its pairs; at least
    half of the poses are kept.
    """
    if len(G) < 4:
        return np.ones(len(G), bool)
    misfit = pose_misfit(angle_misfit(G, P))
    limit = max(APART * float(np.median(misfit)), LEAST_R)
    return np.asarray(misfit <= max(limit, float(np.quantile(misfit, 0.5))))


def angle_misfit(G: Array, P: Array) -> Array:
    """(N, N), rad, by which the angles of the motions between poses differ."""
    R_A = np.einsum("iab,jcb->ijac", G[:, :3, :3], G[:, :3, :3])
    R_B = np.einsum("iab,jcb->ijac", P[:, :3, :3], P[:, :3, :3])
    turn = [np.linalg.norm(se3.log_so3(R), axis=-1) for R in (R_A, R_B)]
    return np.abs(turn[0] - turn[1])


def pose_misfit(misfit: Array) -> Array:
    """(N,), the median over each pose's pairs with others."""
    n = len(misfit)
    others = misfit[~np.eye(n, dtype=bool)].reshape(n, n - 1)
    return np.asarray(np.median(others, axis=1))
