"""Kinematics of a serial arm from Denavit-Hartenberg parameters, nominal or calibrated.

Joint i turns about z of frame i-1: ``T_{i-1,i} = Rz(q + theta) Tz(d) Tx(a) Rx(alpha)`` (Denavit &
Hartenberg 1955, in the standard form that Universal Robots publishes). Frame 0 is the base, the
last one the flange. Metres and radians; all functions are batched over leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import se3

Array = NDArray[np.float64]
Numbers = tuple[float, ...]


@dataclass(frozen=True)
class DhArm:
    """An arm of n rotary joints."""

    a: Numbers
    """Length of each link along its x, m."""
    d: Numbers
    """Offset of each link along its joint's axis, m."""
    alpha: Numbers
    """Twist from each joint's axis to the next, rad."""
    theta: Numbers
    """What is added to each joint's reading, rad."""
    lower: Numbers
    upper: Numbers
    """Joint limits, rad."""
    joints: tuple[str, ...]
    """The joints' names, from the base on."""

    def __post_init__(self) -> None:
        """ValueError where the parameters do not belong to one arm."""
        for field in fields(self):
            value = getattr(self, field.name)
            if len(value) != len(self.joints):
                raise ValueError(
                    f"{field.name} {value}: expected one for each of the {len(self.joints)} joints"
                )
            if field.name != "joints" and not np.isfinite(value).all():
                raise ValueError(f"{field.name} {value}: expected finite numbers")

    def calibrated(
        self,
        a: ArrayLike = 0.0,
        d: ArrayLike = 0.0,
        alpha: ArrayLike = 0.0,
        theta: ArrayLike = 0.0,
    ) -> DhArm:
        """The same arm with small corrections (n,) or () added to its parameters, m and rad."""
        changes = {"a": a, "d": d, "alpha": alpha, "theta": theta}
        return replace(
            self,
            **{
                name: tuple((np.array(getattr(self, name)) + np.asarray(delta, float)).tolist())
                for name, delta in changes.items()
            },
        )

    def links(self) -> Array:
        """The fixed part of each link (n, 4, 4): ``T_{i-1,i}`` at joint reading 0."""
        ct, st = np.cos(self.theta), np.sin(self.theta)
        ca, sa = np.cos(self.alpha), np.sin(self.alpha)
        a, zero = np.asarray(self.a, float), np.zeros(len(self.joints))
        rows = [
            [ct, -st * ca, st * sa, a * ct],
            [st, ct * ca, -ct * sa, a * st],
            [zero, sa, ca, np.asarray(self.d, float)],
            [zero, zero, zero, zero + 1.0],
        ]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    def frames(self, q: ArrayLike) -> Array:
        """The frames ``T_base_i`` (..., n + 1, 4, 4) at joints (..., n); the base comes first."""
        q = self._checked(q)
        turn = np.zeros((*q.shape, 4, 4))
        turn[..., 0, 0] = turn[..., 1, 1] = np.cos(q)
        turn[..., 1, 0] = np.sin(q)
        turn[..., 0, 1] = -turn[..., 1, 0]
        turn[..., 2, 2] = turn[..., 3, 3] = 1.0
        step = turn @ self.links()
        out = np.empty((*q.shape[:-1], len(self.joints) + 1, 4, 4))
        out[..., 0, :, :] = np.eye(4)
        for i in range(len(self.joints)):
            out[..., i + 1, :, :] = out[..., i, :, :] @ step[..., i, :, :]
        return out

    def forward(self, q: ArrayLike) -> Array:
        """``T_base_flange`` (..., 4, 4) at joints (..., n)."""
        return np.asarray(self.frames(q)[..., -1, :, :])

    def jacobian(self, q: ArrayLike) -> Array:
        """The geometric Jacobian (..., 6, n): flange velocity over joint velocity, base axes.

        Rows are the velocity of the flange's origin, then the angular velocity: the delta of
        `se3.retract`. Column i is ``[z x (p_flange - p), z]`` of the joint's axis.
        """
        return _jacobian(self.frames(q))

    def manipulability(self, q: ArrayLike) -> Array:
        """The least singular value (...) of the Jacobian: 0 at a singularity, m and rad mixed."""
        return np.asarray(np.linalg.svd(self.jacobian(q), compute_uv=False)[..., -1])

    def within_limits(self, q: ArrayLike) -> NDArray[np.bool_]:
        """Whether all joints (..., n) keep their limits."""
        q = self._checked(q)
        return np.asarray(((q >= self.lower) & (q <= self.upper)).all(axis=-1))

    def inverse(
        self, T_base_flange: ArrayLike, q0: ArrayLike, tolerance: float = 1e-12, steps: int = 60
    ) -> Array | None:
        """The joints (n,) for a flange pose (4, 4), from the start `q0` (n,); None: not found.

        None does not prove that there is no solution: another start may lead to one.
        """
        q, found = self.solve(T_base_flange, q0, tolerance, steps)
        return q if found else None

    def solve(
        self, T_base_flange: ArrayLike, q0: ArrayLike, tolerance: float = 1e-12, steps: int = 60
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Joints (..., n) for poses (..., 4, 4) from starts (..., n), and where they are right.

        Right: every component of `se3.difference` is at most `tolerance` (m and rad) and the limits
        are kept, if need be by full turns. Damped Newton steps (Levenberg's damping, which falls
        with the error, as in Sugihara 2011); a step turns no joint by more than 0.5 rad. Poses
        beyond the arm's length are not tried.
        """
        T_goal, q0 = np.asarray(T_base_flange, float), self._checked(q0)
        shape = np.broadcast_shapes(T_goal.shape[:-2], q0.shape[:-1])
        n = len(self.joints)
        T_goal = np.broadcast_to(T_goal, (*shape, 4, 4)).reshape(-1, 4, 4)
        q = np.broadcast_to(q0, (*shape, n)).reshape(-1, n).copy()
        right = np.zeros(len(q), np.bool_)
        # Farther away than all links in one line: no joints lead there.
        reach = float(np.hypot(self.a, self.d).sum()) + tolerance
        busy = np.flatnonzero(np.linalg.norm(T_goal[:, :3, 3], axis=-1) <= reach)
        for _ in range(steps + 1):
            frames = self.frames(q[busy])
            error = se3.difference(T_goal[busy], frames[:, -1])
            done = np.abs(error).max(axis=-1, initial=0.0) <= tolerance
            right[busy[done]] = True
            busy, frames, error = busy[~done], frames[~done], error[~done]
            if len(busy) == 0:
                break
            J = _jacobian(frames)
            square = np.einsum("...ij,...kj->...ik", J, J)
            damping = np.minimum(0.1 * np.einsum("...i,...i", error, error), 0.1) + 1e-18
            square += damping[:, None, None] * np.eye(6)
            step = np.einsum(
                "...ij,...i->...j", J, np.linalg.solve(square, error[..., None])[..., 0]
            )
            longest = np.abs(step).max(axis=-1, keepdims=True)
            q[busy] += step * np.minimum(1.0, 0.5 / np.maximum(longest, 1e-300))
        q = self.unwound(q)
        right &= self.within_limits(q)
        return q.reshape(*shape, n), right.reshape(shape)

    def unwound(self, q: ArrayLike) -> Array:
        """The joints (..., n), those beyond a limit brought back by full turns where that helps."""
        q = self._checked(q)
        turn = 2.0 * np.pi
        over = np.ceil(np.maximum(q - self.upper, 0.0) / turn)
        under = np.ceil(np.maximum(self.lower - q, 0.0) / turn)
        return np.asarray(q + turn * (under - over))

    def _checked(self, q: ArrayLike) -> Array:
        q = np.asarray(q, dtype=np.float64)
        if q.ndim == 0 or q.shape[-1] != len(self.joints):
            raise ValueError(f"joints of shape {q.shape}: expected (..., {len(self.joints)})")
        return q


def _jacobian(frames: Array) -> Array:
    """From the frames (..., n + 1, 4, 4) of an arm."""
    axis, p = frames[..., :-1, :3, 2], frames[..., :-1, :3, 3]
    arm = frames[..., -1:, :3, 3] - p
    return np.swapaxes(np.concatenate([np.cross(axis, arm), axis], axis=-1), -1, -2)


UR_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)

_HALF, _TURN = 0.5 * np.pi, 2.0 * np.pi

UR16E = DhArm(
    a=(0.0, -0.4784, -0.36, 0.0, 0.0, 0.0),
    d=(0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655),
    alpha=(_HALF, 0.0, 0.0, _HALF, -_HALF, 0.0),
    theta=(0.0,) * 6,
    # The elbow cannot turn further than the links allow.
    lower=(-_TURN, -_TURN, -np.pi, -_TURN, -_TURN, -_TURN),
    upper=(_TURN, _TURN, np.pi, _TURN, _TURN, _TURN),
    joints=UR_JOINTS,
)
"""The UR16e with the maker's published parameters; frame 0 is the controller's "base"."""
