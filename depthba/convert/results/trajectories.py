"""Poses as TUM, KITTI, g2o and transforms.json."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import durable, se3, trajectory
from depthba.convert import pose_files
from depthba.convert.formats import nerfstudio
from depthba.convert.results.outcome import Outcome, ResultFormat
from depthba.errors import RunError

Array = NDArray[np.float64]

UNKNOWN = 1.0
"""Information of edges, per axis, where there is no covariance."""


def write_tum(outcome: Outcome, path: Path) -> None:
    """Write ``stamp tx ty tz qx qy qz qw``."""
    trajectory.write_tum(path, outcome.stamps, outcome.T_world_camera)


def write_kitti(outcome: Outcome, path: Path) -> None:
    """Write the first three rows of T_world_camera, 12 numbers a line."""
    pose_files.write_kitti(path, outcome.T_world_camera)


def write_transforms(outcome: Outcome, path: Path) -> None:
    """Write transforms.json, which names the images of the dataset where they lie."""
    if outcome.dataset is None:
        raise RunError(f"{outcome.path}: its frames are not known, expected a dataset")
    nerfstudio.write(outcome.dataset(), outcome.T_world_camera, path)


def write_g2o(outcome: Outcome, path: Path) -> None:
    """Write the poses as vertices, and edges between consecutive ones with their information."""
    T, lines = outcome.T_world_camera, []
    for k, pose in enumerate(T):
        lines.append(f"VERTEX_SE3:QUAT {k} {_seven(pose)}")
    lines.append("FIX 0")
    for k in range(len(T) - 1):
        information = edge_information(T, outcome.covariance, k, k + 1)
        upper = " ".join(f"{v:.12g}" for v in information[np.triu_indices(6)])
        measured = _seven(se3.inverse(T[k]) @ T[k + 1])
        lines.append(f"EDGE_SE3:QUAT {k} {k + 1} {measured} {upper}")
    durable.write_text(path, "\n".join(lines) + "\n")


def edge_information(T: Array, covariance: Array | None, i: int, j: int) -> Array:
    """Return the information (6, 6) of ``T_i^-1 T_j`` as g2o has it.

    g2o's error is the translation, and the vector part of the quaternion (half the rotation vector,
    to first order), both in the axes of frame j.

    Args:
        T: (N, 4, 4), T_world_camera.
        covariance: (6N, 6N), of perturbations [t, r] in world axes about each camera's centre.
        i: first frame.
        j: second frame.

    """
    if covariance is None or not covariance.any():
        return UNKNOWN * np.eye(6)
    R_j_world = T[j, :3, :3].T
    J = np.zeros((6, 12))
    # t_ij moves by R_i' (t_j - t_i - phi_i x (p_j - p_i)), seen from frame j
    J[:3, 0:3], J[:3, 6:9] = -R_j_world, R_j_world
    J[:3, 3:6] = R_j_world @ se3.hat(T[j, :3, 3] - T[i, :3, 3])
    J[3:, 3:6], J[3:, 9:12] = -0.5 * R_j_world, 0.5 * R_j_world
    rows = np.concatenate([np.arange(6 * i, 6 * i + 6), np.arange(6 * j, 6 * j + 6)])
    S = J @ covariance[np.ix_(rows, rows)] @ J.T
    w, V = np.linalg.eigh((S + S.T) / 2)
    # what a rounded covariance has as nothing or less is as good as fixed
    w = np.maximum(w, max(float(w.max()), 1e-300) * 1e-12)
    return np.asarray((V / w) @ V.T)


def _seven(T: Array) -> str:
    return " ".join(f"{v:.17g}" for v in (*T[:3, 3], *se3.quaternion(T)))


FORMATS = (
    ResultFormat("tum", "poses, TUM", (".tum", ".txt"), write_tum),
    ResultFormat("kitti", "poses, KITTI", (".kitti",), write_kitti),
    ResultFormat("g2o", "poses and their information, g2o", (".g2o",), write_g2o),
    ResultFormat("transforms", "poses, nerfstudio's transforms.json", (".json",), write_transforms),
)
