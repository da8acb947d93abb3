"""The joints of an arm along a straight line of its flange, quick enough for a control loop.

The place moves evenly from start to goal while the orientation turns evenly about one axis. Each
point of the line is solved from the one before by damped Newton steps, so that the arm never jumps
from one posture to another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import se3
from depthba.compiling import kernel, part
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


@kernel
def flange(links: Array, q: Array) -> Array:
    """``T_base_flange`` (4, 4) at joints (n,); `links` (n, 4, 4) are `DhArm.links`."""
    frames = np.empty((len(q) + 1, 4, 4))
    _frames(links, q, frames)
    T: Array = frames[-1]
    return T


@part
def _frames(links: Array, q: Array, T: Array) -> None:
    """Fill the frames T (n + 1, 4, 4), the base first."""
    for i in range(4):
        for j in range(4):
            T[0, i, j] = 1.0 if i == j else 0.0
    for k in range(len(q)):
        c, s = np.cos(q[k]), np.sin(q[k])
        for i in range(3):
            # A row of T Rz(q).
            x = c * T[k, i, 0] + s * T[k, i, 1]
            y = c * T[k, i, 1] - s * T[k, i, 0]
            z = T[k, i, 2]
            for j in range(4):
                T[k + 1, i, j] = x * links[k, 0, j] + y * links[k, 1, j] + z * links[k, 2, j]
            T[k + 1, i, 3] += T[k, i, 3]
        for j in range(4):
            T[k + 1, 3, j] = T[0, 3, j]


@kernel
def _follow(
    links: Array, lower: Array, upper: Array, T_line: Array, joints: Array
) -> tuple[int, int]:
    """Fill `joints` (k, n) from its first row on; the last row that is right, and why it ends."""
    n = joints.shape[1]
    for k in range(1, len(T_line)):
        joints[k] = joints[k - 1]
        if not _solve(links, T_line[k], joints[k]):
            return k - 1, _NO_SOLUTION
        for i in range(n):
            if not lower[i] <= joints[k, i] <= upper[i]:
                return k - 1, _LIMIT
            if abs(joints[k, i] - joints[k - 1, i]) > JUMP:
                return k - 1, _JUMPED
    return len(T_line) - 1, _DONE


@part
def _solve(links: Array, T_goal: Array, q: Array) -> bool:
    """Bring `q` (n,) to the goal; whether it came there."""
    n = len(q)
    T, J, e = np.empty((n + 1, 4, 4)), np.empty((6, n)), np.empty(6)
    square = np.empty((6, 6))
    for _ in range(_STEPS):
        _frames(links, q, T)
        worst = _error(T_goal, T[n], e)
        if worst < _TOLERANCE:
            return True
        for k in range(n):
            _axis(T[k], T[n], J, k)
        # Damped least norm: J^T (J J^T + lambda I)^-1 e.
        damping = 1e-18
        for i in range(6):
            damping += min(0.1 * e[i] * e[i], 0.02)
        for i in range(6):
            for j in range(6):
                square[i, j] = damping if i == j else 0.0
                for k in range(n):
                    square[i, j] += J[i, k] * J[j, k]
        _solve_symmetric(square, e)
        longest = 0.5
        for k in range(n):
            J[0, k] *= e[0]
            for i in range(1, 6):
                J[0, k] += J[i, k] * e[i]
            longest = max(longest, abs(J[0, k]))
        for k in range(n):
            q[k] += J[0, k] * 0.5 / longest
    return False


@part
def _error(T_goal: Array, T: Array, e: Array) -> float:
    """Fill e (6,), m and rad; its largest component."""
    for i in range(3):
        e[i], e[i + 3] = T_goal[i, 3] - T[i, 3], 0.0
    # The sine of the angle left, times its axis: as good as the angle once it is small.
    for j in range(3):
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            e[i + 3] += 0.5 * (T[a, j] * T_goal[b, j] - T[b, j] * T_goal[a, j])
    worst = 0.0
    for i in range(6):
        worst = max(worst, abs(e[i]))
    return worst


@part
def _axis(T_joint: Array, T_flange: Array, J: Array, k: int) -> None:
    """Fill column k of the Jacobian (6, n): ``[z x (p_flange - p), z]``."""
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        arm_a, arm_b = T_flange[a, 3] - T_joint[a, 3], T_flange[b, 3] - T_joint[b, 3]
        J[i, k] = T_joint[a, 2] * arm_b - T_joint[b, 2] * arm_a
        J[i + 3, k] = T_joint[i, 2]


@part
def _solve_symmetric(A: Array, x: Array) -> None:
    """Solve ``A x = b`` in place, x (m,) is b before; A (m, m), positive definite, is spent."""
    m = len(x)
    for j in range(m):
        for k in range(j):
            A[j, j] -= A[j, k] * A[j, k]
        A[j, j] = np.sqrt(A[j, j])
        for i in range(j + 1, m):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] /= A[j, j]
    for i in range(m):
        for k in range(i):
            x[i] -= A[i, k] * x[k]
        x[i] /= A[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            x[i] -= A[k, i] * x[k]
        x[i] /= A[i, i]
