"""The truth in a dataset is exact, in every scene: checked with MuJoCo's own rays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sim
from depthba.dataset import Dataset, verify
from depthba.se3 import inverse
from sim.engine import mujoco
from sim.scenes import SCENES

JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)


def at_rest(path: Path, joints: np.ndarray | None) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The stored scene, its arm at the joints that a frame reports."""
    model = mujoco.MjModel.from_xml_path(str(path / "scene" / "scene.xml"))
    data = mujoco.MjData(model)
    if joints is not None:
        for name, angle in zip(JOINTS, joints, strict=True):
            data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_forward(model, data)
    return model, data


def mujoco_distance(
    model: mujoco.MjModel, data: mujoco.MjData, eye: np.ndarray, towards: np.ndarray
) -> np.ndarray:
    """Distances (n,) to the first thing along directions (n, 3), in units of their lengths."""
    length = np.linalg.norm(towards, axis=1)
    count = len(length)
    geom, distance = np.empty((count, 1), np.int32), np.empty((count, 1))
    mujoco.mj_multiRay(
        model, data, np.ascontiguousarray(eye), (towards / length[:, None]).reshape(-1, 1),
        np.array([1, 1, 1, 0, 0, 0], np.uint8), 1, -1, geom, distance, None, count, 1e9,
    )  # fmt: skip
    return np.where(geom[:, 0] >= 0, distance[:, 0], np.nan) / length


@pytest.mark.parametrize("scene", sorted(SCENES))
def test_points_lie_on_the_surface(scene: str, tmp_path: Path) -> None:
    """Points of one frame, looked at from the next frame's eye: on the surface, or behind it."""
    options = sim.GenerateOptions(seed=1, size=(96, 64), frames=3, clean=True)
    path = sim.generate(scene, tmp_path / "set", options)
    assert verify(path) == []
    dataset = Dataset.open(path)
    for k, other in ((0, 1), (1, 2)):
        model, data = at_rest(path, dataset[other].joints)
        T = dataset.T_world_camera_true[k]
        points = (dataset[k].points().astype(float) @ T[:3, :3].T + T[:3, 3])[::3]
        assert len(points) > 500
        eye = dataset.T_world_camera_true[other][:3, 3]
        towards = points - eye
        length = np.linalg.norm(towards, axis=1)
        short = (1.0 - mujoco_distance(model, data, eye, towards)) * length
        on = np.abs(short) < 2e-3
        assert on.mean() > 0.5, "most of what one frame sees the next one sees too"
        assert np.median(np.abs(short[on])) < 5e-5
        assert np.mean(short < -2e-3) < 0.02  # it may slip past an edge, but not through


@pytest.mark.parametrize("scene", ["lab-1", "handeye-board"])
def test_an_arms_reports_close_the_chain(scene: str, tmp_path: Path) -> None:
    """Clean: camera = flange of the reported joints, times the hand-eye transform."""
    options = sim.GenerateOptions(seed=2, size=(32, 24), frames=4, clean=True, rgb=False)
    path = sim.generate(scene, tmp_path / "set", options)
    dataset = Dataset.open(path)
    assert dataset.T_flange_camera is not None
    for frame, T_true in zip(dataset, dataset.T_world_camera_true, strict=True):
        _, data = at_rest(path, frame.joints)
        site = data.site("flange")
        T_world_flange = np.eye(4)
        T_world_flange[:3, :3], T_world_flange[:3, 3] = site.xmat.reshape(3, 3), site.xpos
        T = T_world_flange @ dataset.T_flange_camera
        step = inverse(T) @ T_true
        assert np.linalg.norm(step[:3, 3]) < 1e-6
        assert np.abs(step[:3, :3] - np.eye(3)).max() < 1e-6
