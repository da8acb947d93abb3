"""The robot's side of a calibration: its poses, how they move with the joints, how it turned."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.dataset import Dataset
from depthba.errors import DatasetError
from depthba.kinematics import UR16E, DhArm

Array = NDArray[np.float64]

# Arms whose kinematics are known, and how close to them the reported flanges must be, m and rad.
ARMS = (UR16E,)
ALIKE = 0.02
# Turns of the flange (root mean square, rad) below which an axis counts as never turned about.
STILL = 0.01


def flange_poses(dataset: Dataset, least: int = 3) -> Array:
    """Return (N, 4, 4) T_base_flange.

    Raises:
        DatasetError: a frame has none, or there are fewer than `least`.
    """
    poses = []
    for frame in dataset:
        if frame.T_base_flange is None:
            raise DatasetError(
                f"{dataset.path}: frame {frame.id} has no T_base_flange in frames.jsonl; "
                "hand-eye calibration needs the robot's flange pose of every frame"
            )
        poses.append(frame.T_base_flange)
    if len(poses) < least:
        raise DatasetError(
            f"{dataset.path}: {len(poses)} frames, but hand-eye calibration needs at least {least}"
        )
    return np.stack(poses)


def known_arm(dataset: Dataset, T_base_flange: Array) -> tuple[DhArm, Array] | None:
    """Return the arm and the joints (N, n) behind the flange poses; None where it is not known.

    That is where the frames have no joints, or those of another arm.
    """
    joints = [frame.joints for frame in dataset]
    for arm in ARMS:
        if all(q is not None and len(q) == len(arm.joints) for q in joints):
            q = np.stack([q for q in joints if q is not None])
            if np.abs(se3.difference(arm.forward(q), T_base_flange)).max() < ALIKE:
                return arm, q
    return None


def joint_motions(dataset: Dataset, T_base_flange: Array) -> Array:
    """Return (6N, n), how the flanges move with the joints, m and rad per rad.

    Empty where the arm is not known. An arm calibrated by its maker differs from its drawings by
    millimetres, and these motions by a hundredth.
    """
    known = known_arm(dataset, T_base_flange)
    if known is None:
        return np.zeros((6 * len(dataset), 0))
    arm, q = known
    return arm.jacobian(q).reshape(6 * len(q), -1)


def turned(T_base_flange: Array) -> tuple[Array, Array]:
    """Return how much the flange turned between frames, and about which axes.

    Returns:
        (3,) rad, root mean square over all pairs of frames, the largest first, and the axes (3, 3),
        one a column, in flange axes.
    """
    R = T_base_flange[:, :3, :3]
    i, j = np.triu_indices(len(R), 1)
    turns = se3.log_so3(np.swapaxes(R[i], -1, -2) @ R[j])
    values, axes = np.linalg.eigh(turns.T @ turns / max(len(turns), 1))
    return np.sqrt(np.maximum(values, 0.0))[::-1], axes[:, ::-1]


def motion_fault(T_base_flange: Array) -> str:
    """Say what the motions leave open whatever the scene; empty where they leave nothing.

    A shift of X moves all cameras alike, and so only the map, unless the flange turns; along an
    axis that all turns share, they do not help.
    """
    size, axes = turned(T_base_flange)
    if size[0] < STILL:
        return (
            "the flange never turned: the camera's place on it is not observable, only its "
            "orientation, which is the mounting tilt against the axes"
        )
    if size[1] < STILL:
        axis = axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0])
        shown = ", ".join(f"{v + 0.0:.2f}" for v in np.round(axis, 2))
        return (
            f"all turns of the flange have the parallel axis ({shown}): the camera's place along "
            "it is not observable"
        )
    return ""
