"""Rigid motions as 4x4 matrices, rotations as rotation vectors; all batched over leading axes.

A perturbation ``delta = [tau, phi]`` moves a pose in world axes about its own origin:
``R <- Exp(phi) R`` and ``t <- t + tau``. Translation and rotation stay uncoupled, so a covariance
reads in metres and radians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_SERIES_BELOW = 1e-4
"""Squared angle (rad^2) under which the Taylor series is exact to rounding."""


def hat(v: ArrayLike) -> Array:
    """Return the matrices (..., 3, 3) of vectors (..., 3): ``hat(a) @ b == cross(a, b)``."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -v[..., 0], -v[..., 1], -v[..., 2]
    return out


def exp_so3(phi: ArrayLike) -> Array:
    """Return the matrices (..., 3, 3) of rotation vectors (..., 3), radians (Rodrigues)."""
    phi = np.asarray(phi, dtype=np.float64)
    s = np.sum(phi * phi, axis=-1)
    small = s < _SERIES_BELOW
    theta = np.sqrt(np.where(small, 1.0, s))
    # sin(theta)/theta, and (1 - cos(theta))/theta^2 through the half angle, which does not cancel.
    a = np.where(small, 1 + s * (-1 / 6 + s * (1 / 120 - s / 5040)), np.sin(theta) / theta)
    b = np.where(
        small,
        0.5 + s * (-1 / 24 + s * (1 / 720 - s / 40320)),
        0.5 * (np.sin(theta / 2) / (theta / 2)) ** 2,
    )
    K = hat(phi)
    return np.asarray(np.eye(3) + a[..., None, None] * K + b[..., None, None] * (K @ K))


def log_so3(R: ArrayLike) -> Array:
    """Return the rotation vectors (..., 3), radians, at most pi long, of matrices (..., 3, 3)."""
    q = _quaternion_of_rotation(np.asarray(R, dtype=np.float64))
    v, w = q[..., :3], q[..., 3]
    n = np.linalg.norm(v, axis=-1)
    # 2 atan2(n, w) / n is well conditioned from 0 to pi, unlike the arc cosine of the trace.
    tiny = n < 1e-8
    safe = np.where(tiny, 1.0, n)
    factor = np.where(tiny, 2.0, 2 * np.arctan2(safe, w) / safe)
    return np.asarray(factor[..., None] * v)


def make(R: ArrayLike, t: ArrayLike) -> Array:
    """Return the transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3), m."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    shape = np.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def inverse(T: ArrayLike) -> Array:
    """Return the inverses (..., 4, 4) of rigid transforms (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    R_inv = np.swapaxes(T[..., :3, :3], -1, -2)
    return make(R_inv, -(R_inv @ T[..., :3, 3:])[..., 0])


def retract(T: ArrayLike, delta: ArrayLike) -> Array:
    """Move poses (..., 4, 4) by ``delta = [tau, phi]`` (..., 6), metres and radians, world axes."""
    T, delta = np.asarray(T, dtype=np.float64), np.asarray(delta, dtype=np.float64)
    return make(exp_so3(delta[..., 3:]) @ T[..., :3, :3], T[..., :3, 3] + delta[..., :3])


def difference(T_a: ArrayLike, T_b: ArrayLike) -> Array:
    """Return the delta (..., 6), metres and radians, for which ``retract(T_b, delta) == T_a``."""
    T_a, T_b = np.asarray(T_a, dtype=np.float64), np.asarray(T_b, dtype=np.float64)
    phi = log_so3(T_a[..., :3, :3] @ np.swapaxes(T_b[..., :3, :3], -1, -2))
    return np.concatenate([T_a[..., :3, 3] - T_b[..., :3, 3], phi], axis=-1)


def align_first(T_est: ArrayLike, T_ref: ArrayLike) -> Array:
    """Move a trajectory (N, 4, 4) rigidly, so that it begins as ``T_ref`` (N, 4, 4) does."""
    T_est, T_ref = np.asarray(T_est, dtype=np.float64), np.asarray(T_ref, dtype=np.float64)
    return np.asarray(T_ref[0] @ inverse(T_est[0]) @ T_est)


def from_quaternion(t: ArrayLike, q_xyzw: ArrayLike) -> Array:
    """Return transforms (..., 4, 4) of translations (..., 3) and quaternions (..., 4), x y z w.

    The quaternion is normalised; one of length zero gives NaN, so check what comes from outside.
    """
    q = np.asarray(q_xyzw, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    K = hat(q[..., :3])
    R = np.eye(3) + 2 * q[..., 3, None, None] * K + 2 * (K @ K)
    return make(R, t)


def quaternion(T: ArrayLike) -> Array:
    """Return the unit quaternions (..., 4), x y z w with w >= 0, of transforms (..., 4, 4)."""
    return _quaternion_of_rotation(np.asarray(T, dtype=np.float64)[..., :3, :3])


def is_rigid(T: ArrayLike, tolerance: float = 1e-5) -> bool:
    """Tell whether all of ``T`` (..., 4, 4) are finite and rigid to ``tolerance``."""
    T = np.asarray(T, dtype=np.float64)
    if T.shape[-2:] != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[..., :3, :3]
    orthonormal = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(initial=0.0) <= tolerance
    last_row = np.abs(T[..., 3, :] - [0, 0, 0, 1]).max(initial=0.0) <= tolerance
    return bool(orthonormal and last_row and (np.linalg.det(R) > 0).all())


def _quaternion_of_rotation(R: Array) -> Array:
    """Take the row of 4 q q^T with the largest diagonal, so that nothing small divides."""
    m = [[R[..., i, j] for j in range(3)] for i in range(3)]
    xy, xz, yz = m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]
    xw, yw, zw = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    xx = 1 + m[0][0] - m[1][1] - m[2][2]
    yy = 1 - m[0][0] + m[1][1] - m[2][2]
    zz = 1 - m[0][0] - m[1][1] + m[2][2]
    ww = 1 + m[0][0] + m[1][1] + m[2][2]
    rows = [[xx, xy, xz, xw], [xy, yy, yz, yw], [xz, yz, zz, zw], [xw, yw, zw, ww]]
    outer = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    best = np.argmax(np.stack([xx, yy, zz, ww], axis=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0, -q, q))
