"""Where the board is in each image: T_camera_board from its corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import Camera
from rig.hand_eye.board import lens
from rig.hand_eye.board.observations import FEWEST_CORNERS, Observations

Array = NDArray[np.float64]

STEPS = 20
# Poses that differ by less, m and in their rotations, are one.
SAME = 1e-6


@dataclass(frozen=True)
class BoardPoses:
    """Where each image has the board."""

    T_camera_board: Array
    """(N, 4, 4); NaN where the image has too few corners."""
    T_camera_board_second: Array
    """(N, 4, 4), the other pose that a flat board seen from afar may have; NaN: there is none."""
    rms: Array
    """(N, 2) px, of the two, root mean square over coordinates."""


def board_poses(observations: Observations, camera: Camera | None = None) -> BoardPoses:
    """Find the board in every image: both poses of a plane (Collins & Bartoli 2014), refined.

    Args:
        observations: the corners.
        camera: the intrinsics; None: the observations'.
    """
    import cv2  # slow to import, so only where it is used

    camera = observations.camera if camera is None else camera
    n = len(observations)
    poses, rms = np.full((n, 2, 4, 4), np.nan), np.full((n, 2), np.nan)
    for k, (pixels, seen) in enumerate(zip(observations.pixels, observations.seen, strict=True)):
        if seen.sum() < FEWEST_CORNERS:
            continue
        points = observations.points[seen]
        found = cv2.solvePnPGeneric(
            points,
            pixels[seen],
            camera.matrix,
            np.array(camera.distortion),
            flags=cv2.SOLVEPNP_IPPE,
        )
        for m, (r, t) in enumerate(zip(found[1][:2], found[2][:2], strict=True)):
            start = se3.make(se3.exp_so3(r.ravel()), t.ravel())
            if np.isfinite(start).all():
                poses[k, m], rms[k, m] = refine(start, points, pixels[seen], camera)
        order = np.argsort(np.where(np.isnan(rms[k]), np.inf, rms[k]))
        poses[k], rms[k] = poses[k][order], rms[k][order]
        if np.abs(poses[k, 0] - poses[k, 1]).max() < SAME:  # one valley after all
            poses[k, 1], rms[k, 1] = np.nan, np.nan
    return BoardPoses(poses[:, 0], poses[:, 1], rms)


def refine(T: Array, points: Array, pixels: Array, camera: Camera) -> tuple[Array, float]:
    """Return the pose (4, 4) of least reprojection error near T, and that, px rms.

    Levenberg-Marquardt over points (n, 3), m, and pixels (n, 2).
    """

    def at(T: Array) -> tuple[Array, Array]:
        arm = points @ T[:3, :3].T
        seen, J, _ = lens.project(arm + T[:3, 3], camera)
        return seen - pixels, np.concatenate([J, -J @ se3.hat(arm)], axis=-1)

    error, J = at(T)
    damping = 1e-4
    for _ in range(STEPS):
        H, g = np.einsum("nik,nil->kl", J, J), np.einsum("nik,ni->k", J, error)
        if not np.isfinite(H).all():
            return np.full((4, 4), np.nan), float("nan")
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.eye(6), g)
        candidate = se3.retract(T, step)
        after, J_after = at(candidate)
        if float(np.square(after).sum()) <= float(np.square(error).sum()):
            T, error, J, damping = candidate, after, J_after, damping / 10
            if np.abs(step).max() < 1e-10:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return T, float(np.sqrt(np.square(error).mean()))
