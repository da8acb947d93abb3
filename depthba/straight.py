"""The joints of an arm along a straight line of its flange, compiled: quick enough for a control loop.

The place moves evenly from start to goal while the orientation turns evenly about one axis. Each
point of the line is solved from the one before by damped Newton steps, so that the arm never jumps
from one posture to another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import se3
from depthba.errors import OutOfReach
from depthba.kinematics import DhArm

Array = NDArray[np.float64]

SPACING = (0.01, 0.02)
"""At most between two points of a line, m and rad."""

JUMP = 0.3
"""No joint turns further from one point to the next, rad: it would be near a singularity."""

_TOLERANCE, _STEPS = 1e-11, 20
_DONE, _NO_SOLUTION, _LIMIT, _JUMPED = range(4)
_REASONS = {
    _NO_SOLUTION: "no joints reach it",
    _LIMIT: "a joint would pass its limit",
    _JUMPED: "it runs into a singularity",
}


@dataclass(frozen=True, eq=False)
class Line:
    """A straight line of the flange."""

    length: float
    """m."""
    angle: float
    """By which the flange turns on the way, rad."""
    joints: Array
    """(k, n) at points spread evenly, the start and the goal among them, rad."""


def straight(arm: DhArm, q0: ArrayLike, T_base_flange: ArrayLike) -> Line:
    """The line from joints `q0` (n,) to a flange pose (4, 4).

    OutOfReach says how far along the line the arm comes, and what stops it there.
    """
    q0, T_goal = np.asarray(q0, float), np.asarray(T_base_flange, float)
    T_start = arm.forward(q0)
    way = T_goal[:3, 3] - T_start[:3, 3]
    turn = se3.log_so3(T_start[:3, :3].T @ T_goal[:3, :3])
    length, angle = float(np.linalg.norm(way)), float(np.linalg.norm(turn))
    count = max(int(np.ceil(max(length / SPACING[0], angle / SPACING[1]))), 4)
    share = np.linspace(0.0, 1.0, count + 1)[:, None]
    R = T_start[:3, :3] @ se3.exp_so3(share * turn)
    T_line = se3.make(R, T_start[:3, 3] + share * way)
    joints = np.empty((count + 1, len(q0)))
    joints[0] = q0
    lower, upper = np.array(arm.lower), np.array(arm.upper)
    reached, reason = _follow(arm.links(), lower, upper, T_line, joints)
    if reason != _DONE:
        raise OutOfReach(
            f"a straight line of {length:.3g} m and {np.degrees(angle):.3g}° ends after "
            f"{100.0 * reached / count:.0f} % of it: {_REASONS[reason]}"
        )
    return Line(length, angle, joints)


@nb.njit(cache=True, nogil=True)
def flange(links: Array, q: Array) -> Array:
    """``T_base_flange`` (4, 4) at joints (n,); `links` (n, 4, 4) are `DhArm.links`."""
    return _frames(links, q)[-1]


@nb.njit(cache=True, nogil=True)
def _frames(links: Array, q: Array) -> Array:
    """Frames (n + 1, 4, 4), the base first."""
    n = len(q)
    T = np.zeros((n + 1, 4, 4))
    for i in range(4):
        T[0, i, i] = 1.0
    for k in range(n):
        c, s = np.cos(q[k]), np.sin(q[k])
        for i in range(3):
            # The columns of T Rz(q).
            x = c * T[k, i, 0] + s * T[k, i, 1]
            y = c * T[k, i, 1] - s * T[k, i, 0]
            for j in range(4):
                T[k + 1, i, j] = x * links[k, 0, j] + y * links[k, 1, j] + T[k, i, 2] * links[k, 2, j]
            T[k + 1, i, 3] += T[k, i, 3]
        T[k + 1, 3, 3] = 1.0
    return T


@nb.njit(cache=True, nogil=True)
def _follow(
    links: Array, lower: Array, upper: Array, T_line: Array, joints: Array
) -> tuple[int, int]:
    """Fill `joints` (k, n) from its first row on; the last row that is right, and why it ends."""
    for k in range(1, len(T_line)):
        q = joints[k - 1].copy()
        if not _solve(links, T_line[k], q):
            return k - 1, _NO_SOLUTION
        if np.any(q < lower) or np.any(q > upper):
            return k - 1, _LIMIT
        if np.max(np.abs(q - joints[k - 1])) > JUMP:
            return k - 1, _JUMPED
        joints[k] = q
    return len(T_line) - 1, _DONE


@nb.njit(cache=True, nogil=True)
def _solve(links: Array, T_goal: Array, q: Array) -> bool:
    """Bring `q` (n,) to the goal; whether it came there."""
    n = len(q)
    J, e = np.empty((6, n)), np.empty(6)
    for _ in range(_STEPS):
        T = _frames(links, q)
        # Twice the sine of the angle left, times its axis: as good as the angle once it is small.
        e[3:] = 0.0
        for j in range(3):
            e[j] = T_goal[j, 3] - T[n, j, 3]
            e[3:] += 0.5 * np.cross(T[n, :3, j], T_goal[:3, j])
        if np.max(np.abs(e)) < _TOLERANCE:
            return True
        for i in range(n):
            axis = T[i, :3, 2].copy()
            J[:3, i] = np.cross(axis, T[n, :3, 3] - T[i, :3, 3])
            J[3:, i] = axis
        square = J @ J.T
        damping = min(0.1 * np.sum(e * e), 0.1) + 1e-18
        for i in range(6):
            square[i, i] += damping
        step = J.T @ np.linalg.solve(square, e)
        longest = np.max(np.abs(step))
        q += step * min(1.0, 0.5 / max(longest, 1e-300))
    return False
