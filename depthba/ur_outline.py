"""The outline of a UR16e: capsules around its links, and whether they are before a camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import Camera
from depthba.kinematics import UR16E, DhArm

Array = NDArray[np.float64]
Point = tuple[float, float, float]

_A2, _A3 = UR16E.a[1], UR16E.a[2]
_D1, _D4, _D5, _D6 = UR16E.d[0], UR16E.d[3], UR16E.d[4], UR16E.d[5]
UPPER, FORE = 0.176, 0.039
"""How far the tubes lie from the frames that the parameters put in the shoulder's plane, m."""

LINKS = ("base", "shoulder", "upper arm", "forearm", "wrist 1", "wrist 2", "wrist 3")


@dataclass(frozen=True)
class Hull:
    """A capsule from `start` to `end`, m, in the frame of a link: 0 the base, i what joint i turns.

    That frame is DH frame i - 1, turned with the joint.
    """

    link: int
    start: Point
    end: Point
    radius: float


HULLS = (
    Hull(0, (0, 0, 0.0), (0, 0, 0.06), 0.097),
    Hull(1, (0, 0, 0.125), (0, 0, _D1), 0.085),
    Hull(1, (0, 0.045, _D1), (0, -0.055, _D1), 0.090),
    Hull(2, (0, 0, 0.155), (0, 0, 0.200), 0.095),
    Hull(2, (0, 0, UPPER), (_A2, 0, UPPER), 0.066),
    Hull(2, (_A2, 0, 0.150), (_A2, 0, 0.200), 0.076),
    Hull(3, (0, 0, 0.060), (0, 0, 0.015), 0.077),
    Hull(3, (0, 0, FORE), (_A3, 0, FORE), 0.054),
    Hull(3, (_A3, 0, 0.022), (_A3, 0, 0.055), 0.060),
    Hull(4, (0, 0, 0.130), (0, 0, 0.190), 0.060),
    Hull(4, (0, 0, _D4), (0, -0.020, _D4), 0.063),
    Hull(5, (0, 0, 0.105), (0, 0, 0.135), 0.060),
    Hull(5, (0, 0, _D5), (0, 0.025, _D5), 0.064),
    Hull(6, (0, 0, 0.080), (0, 0, 0.088), 0.048),
    Hull(6, (0, 0, _D6 + 0.004), (0.029, -0.0503, _D6 + 0.004), 0.047),
)
"""Around all that the drawings show of the arm."""

_SHARES = np.linspace(0.0, 1.0, 17)
_BULGE = 1.07
"""A capsule as balls along its axis; three quarters of a radius apart they leave 7 %."""


def in_view(
    arm: DhArm, joints: Array, T_flange_camera: Array, camera: Camera, rim: float = 0.0
) -> str | None:
    """Which part of the arm is in its own camera's view, behind other things too; None: none.

    What turns with the camera is not looked at: it is where it is in every frame.

    Args:
        arm: a UR16e, calibrated or not.
        joints: (n,) rad.
        T_flange_camera: (4, 4).
        camera: whose image it must not be in; distortion is left out of account.
        rim: what must stay free beside the image, rad.
    """
    frames = arm.frames(joints)
    T_camera_base = se3.inverse(frames[-1] @ T_flange_camera)
    sides = _sides(camera, rim)
    for hull in HULLS:
        if hull.link == len(LINKS) - 1:
            continue
        R = np.eye(3)
        if hull.link:
            q = joints[hull.link - 1]
            R = se3.exp_so3([0.0, 0.0, q])
        T = T_camera_base @ frames[max(hull.link - 1, 0)] @ se3.make(R, np.zeros(3))
        ends = np.array([hull.start, hull.end]) @ T[:3, :3].T + T[:3, 3]
        balls = ends[0] + _SHARES[:, None] * (ends[1] - ends[0])
        if (np.min(balls @ sides.T, axis=-1) > -_BULGE * hull.radius).any():
            return LINKS[hull.link]
    return None


def _sides(camera: Camera, rim: float) -> Array:
    """Inward unit normals (4, 3) of the planes through the image's edges, camera frame."""
    edges = np.array(
        [
            (camera.cx + 0.5) / camera.fx,
            (camera.width - 0.5 - camera.cx) / camera.fx,
            (camera.cy + 0.5) / camera.fy,
            (camera.height - 0.5 - camera.cy) / camera.fy,
        ]
    )
    angle = np.arctan(edges) + rim
    c, s = np.cos(angle), np.sin(angle)
    zero = np.zeros(2)
    x = np.stack([c[:2] * [1.0, -1.0], zero, s[:2]], axis=-1)
    y = np.stack([zero, c[2:] * [1.0, -1.0], s[2:]], axis=-1)
    return np.concatenate([x, y])
