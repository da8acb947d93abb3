"""Camera poses from flange poses and a hand-eye transform: poses_arm.txt of a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import se3, trajectory
from depthba.dataset import Dataset
from depthba.errors import OptionError
from rig.hand_eye.flanges import flange_poses
from rig.hand_eye.record import HandEyeRecord

Array = NDArray[np.float64]

FILE = "poses_arm.txt"
# By how much the measured poses may differ from the chain behind them, m and rad, for its base to
# stand in the world as they say.
SAME = 1e-4


@dataclass(frozen=True, eq=False)
class Applied:
    """What was written."""

    path: Path
    T_world_camera: Array
    """(N, 4, 4)."""
    world: str
    """Which frame the poses are in, for people."""


def base_in_world(dataset: Dataset, T_base_flange: Array) -> Array | None:
    """Return T_world_base (4, 4) behind the measured poses; None where they do not tell.

    They do where dataset.json has the T_flange_camera that they were made with.
    """
    if dataset.T_flange_camera is None:
        return None
    T = dataset.T_world_camera_measured @ se3.inverse(T_base_flange @ dataset.T_flange_camera)
    if np.abs(se3.difference(T, T[0])).max() > SAME:
        return None
    return np.asarray(T[0])


def apply(dataset: Dataset, record: HandEyeRecord) -> Applied:
    """Write poses_arm.txt: ``T_world_camera = T_world_base T_base_flange X`` of every frame.

    The world is that of the measured poses where they tell how the base stands in it, else the
    base; with the eye to the hand it is the flange, on which the scene then rides.

    Raises:
        DatasetError: a frame has no flange pose.
        OptionError: the calibration is not to be trusted.
    """
    if record.T is None or not record.trusted:
        raise OptionError(
            f"the calibration is {record.verdict}, expected one to be trusted: {record.reason}"
        )
    T_base_flange = flange_poses(dataset, least=1)
    if record.mount == "eye-to-hand":
        world, T = "flange", se3.inverse(T_base_flange) @ record.T
    else:
        T_world_base = base_in_world(dataset, T_base_flange)
        world = "world" if T_world_base is not None else "base"
        T = (np.eye(4) if T_world_base is None else T_world_base) @ T_base_flange @ record.T
    path = dataset.path / FILE
    comment = f"T_{world}_camera by the arm and the hand-eye calibration ({record.method})"
    trajectory.write_tum(path, dataset.stamps, T, comment)
    return Applied(path, np.asarray(T), world)
