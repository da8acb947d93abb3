"""Errors of estimated poses against true ones, with their units.

Poses are ``T_world_camera``. An error is a left perturbation about the camera centre, in world
axes: ``t_est - t_true`` in metres and ``log(R_est R_true^T)`` in radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from depthba import se3

Floats = NDArray[np.float64]
Unit = Literal["m", "rad", "1"]
Better = Literal["lower", "higher", "one"]

AXES = ("x", "y", "z")
START = "start_"
"""Begins the names of what the start poses score."""


@dataclass(frozen=True)
class Metric:
    """One figure of merit."""

    name: str
    """Such as ``translation_mae``; figures of the start poses begin with ``start_``."""
    unit: Unit
    better: Better
    """Which way is better; ``one``: the nearer to 1."""
    value: float
    """NaN where the data do not tell."""


def pose_errors(T_est: Floats, T_true: Floats) -> Floats:
    """Return (N, 6) errors, translation then rotation, of poses in the same frame."""
    return se3.difference(T_est, T_true)


def pose_metrics(T_est: Floats, T_true: Floats) -> list[Metric]:
    """Judge a trajectory by the truth.

    Args:
        T_est: (N, 4, 4), in any world frame; frame 0 is put onto the truth's.
        T_true: (N, 4, 4).

    Returns:
        Mean absolute error, root mean square and largest magnitude over frames 1 and on, the
        first two per axis as well; the trajectory error after the best rigid alignment; the
        relative pose error between consecutive frames.

    """
    errors = pose_errors(se3.align_first(T_est, T_true), T_true)[1:]
    parts: tuple[tuple[str, Unit, Floats], ...] = (
        ("translation", "m", errors[:, :3]),
        ("rotation", "rad", errors[:, 3:]),
    )
    out = []
    for name, unit, e in parts:
        out.append(Metric(f"{name}_mae", unit, "lower", _mean(np.abs(e))))
        out.append(Metric(f"{name}_rmse", unit, "lower", _rms(e)))
        out.append(Metric(f"{name}_max", unit, "lower", float(np.abs(e).max(initial=0.0))))
        for k, axis in enumerate(AXES):
            out.append(Metric(f"{name}_mae_{axis}", unit, "lower", _mean(np.abs(e[:, k]))))
            out.append(Metric(f"{name}_rmse_{axis}", unit, "lower", _rms(e[:, k])))
    out.append(Metric("ate_rmse", "m", "lower", absolute_trajectory_error(T_est, T_true)))
    moved, turned = relative_pose_error(T_est, T_true)
    out.append(Metric("rpe_translation_rmse", "m", "lower", moved))
    out.append(Metric("rpe_rotation_rmse", "rad", "lower", turned))
    return out


def rigid_alignment(points: Floats, onto: Floats) -> tuple[Floats, Floats]:
    """Return R (3, 3) and t (3,) that minimise ``|R p + t - q|`` over pairs of points (n, 3).

    Umeyama, Least-squares estimation of transformation parameters between two point patterns
    (1991), without scale.
    """
    p0, q0 = points.mean(axis=0), onto.mean(axis=0)
    U, _, Vt = np.linalg.svd((onto - q0).T @ (points - p0))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return R, q0 - R @ p0


def absolute_trajectory_error(T_est: Floats, T_true: Floats) -> float:
    """Return the root mean square distance of the camera centres after rigid alignment, metres."""
    centres, true = T_est[:, :3, 3], T_true[:, :3, 3]
    R, t = rigid_alignment(centres, true)
    return float(np.sqrt(np.mean(np.sum((centres @ R.T + t - true) ** 2, axis=1))))


def relative_pose_error(T_est: Floats, T_true: Floats) -> tuple[float, float]:
    """Return root mean square errors of the motion from frame to frame, metres and radians."""
    if len(T_est) < 2:
        return float("nan"), float("nan")
    moved_est = se3.inverse(T_est[:-1]) @ T_est[1:]
    moved_true = se3.inverse(T_true[:-1]) @ T_true[1:]
    wrong = se3.inverse(moved_true) @ moved_est
    angles = np.linalg.norm(se3.log_so3(wrong[:, :3, :3]), axis=-1)
    return _rms(np.linalg.norm(wrong[:, :3, 3], axis=-1)), _rms(angles)


@dataclass(frozen=True)
class Consistency:
    """Whether the errors are as large as the covariance says."""

    nees_per_dof: float
    """Normalised estimation error squared per degree of freedom: 1 is an honest covariance."""
    dof: int
    """Degrees of freedom that were judged: 6N - 6, less directions that have no variance."""


def consistency(T_est: Floats, T_true: Floats, covariance: Floats) -> Consistency:
    """Judge a joint covariance by the truth, frame 0 anchored.

    Args:
        T_est: (N, 4, 4).
        T_true: (N, 4, 4).
        covariance: (6N, 6N), translation then rotation per frame, world axes of the estimate,
            left perturbation about the camera centre. Frame 0 may be certain (zeros) or not: what
            counts is relative to it.

    """
    n = len(T_est)
    aligned = se3.align_first(T_est, T_true)
    errors = pose_errors(aligned, T_true)[1:].ravel()
    turn = np.kron(np.eye(2), T_true[0, :3, :3] @ T_est[0, :3, :3].T)
    relative = np.zeros((6 * n - 6, 6 * n))
    for i in range(1, n):
        rows = slice(6 * i - 6, 6 * i)
        relative[rows, 6 * i : 6 * i + 6] = turn
        # aligning by frame 0 turns its own error around into every other frame:
        # t_i loses tau_0 + phi_0 x (t_i - t_0), R_i loses phi_0
        lever = T_est[i, :3, 3] - T_est[0, :3, 3]
        carried = -np.eye(6)
        carried[:3, 3:] = _cross(lever)
        relative[rows, :6] = turn @ carried
    joint = relative @ covariance @ relative.T
    scale = np.sqrt(np.maximum(np.diag(joint), 0.0))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(joint / np.outer(scale, scale))
    known = values > 1e-12 * max(
        float(values.max(initial=0.0)), 1e-300
    )  # held frames have no variance
    along = vectors.T @ (errors / scale)
    dof = int(known.sum())
    total = float(np.sum(along[known] ** 2 / values[known]))
    return Consistency(total / dof if dof else float("nan"), dof)


def over_bound(metrics: Sequence[Metric], translation: float, rotation: float) -> list[Metric]:
    """Return the least mean absolute errors (m, rad) as metrics, and the errors over them."""
    now = {m.name: m.value for m in metrics}
    least: tuple[tuple[str, Unit, float], ...] = (
        ("translation", "m", translation),
        ("rotation", "rad", rotation),
    )
    return [
        *(Metric(f"{name}_bound", unit, "lower", value) for name, unit, value in least),
        *(
            Metric(f"{name}_over_bound", "1", "lower", now[f"{name}_mae"] / value)
            for name, _, value in least
        ),
    ]


def start(metrics: Sequence[Metric]) -> list[Metric]:
    """Return the metrics renamed as those of the start poses."""
    return [Metric(f"{START}{m.name}", m.unit, m.better, m.value) for m in metrics]


def split(metrics: Sequence[Metric]) -> tuple[list[Metric], list[Metric]]:
    """Undo `start`: return the metrics of the estimate and those of the start poses."""
    estimate = [m for m in metrics if not m.name.startswith(START)]
    before = [
        Metric(m.name.removeprefix(START), m.unit, m.better, m.value)
        for m in metrics
        if m.name.startswith(START)
    ]
    return estimate, before


def _cross(v: Floats) -> Floats:
    """Return the matrix of ``v x``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _mean(values: Floats) -> float:
    return float(values.mean()) if values.size else float("nan")


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
