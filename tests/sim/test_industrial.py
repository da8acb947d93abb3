from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import sim
from depthba.dataset import Dataset, verify
from depthba.se3 import inverse
from sim.engine import mujoco
from sim.rendering.raycast import RayScene
from sim.rigs.gantry import Gantry
from sim.scenes import find_scene
from sim.sensors import SP1000


def world_points(dataset: Dataset, k: int) -> np.ndarray:
    T = dataset.T_world_camera_true[k]
    return dataset[k].points() @ T[:3, :3].T + T[:3, 3]


def test_the_writer_made_a_faultless_dataset(clean_bay: Path, noisy_bay: Path) -> None:
    for path in (clean_bay, noisy_bay):
        assert verify(path) == []
        dataset = Dataset.open(path)
        assert len(dataset) == 21 and dataset.warnings == () and dataset.map_frame == "world"
        assert "created" not in dataset.header
    clean, noisy = Dataset.open(clean_bay), Dataset.open(noisy_bay)
    assert all(np.isfinite(frame.depth()).mean() > 0.999 for frame in clean)
    assert all(np.isfinite(frame.depth()).mean() > 0.9 for frame in noisy)  # shadows, dropouts
    assert clean.pose_noise is None


def test_the_truth_is_exact(clean_bay: Path, bay_model: mujoco.MjModel) -> None:
    """Points of one frame, seen from its neighbour's eye: on the surface, or hidden by it."""
    dataset, scene = Dataset.open(clean_bay), RayScene.of_model(bay_model)
    for k in range(0, 20, 4):
        points = world_points(dataset, k)
        eye = dataset.T_world_camera_true[k + 1][:3, 3]
        towards = points - eye
        length = np.linalg.norm(towards, axis=1)
        short = (1.0 - scene.cast(eye, towards).distance) * length
        assert np.median(np.abs(short)) < 5e-5
        assert np.mean(short < -1e-3) < 0.01  # it may slip past an edge, but not through
        assert 0.003 < np.mean(short > 5e-3) < 0.35  # and rubble does hide some


def test_clean_poses_are_true_and_gantry_like(clean_bay: Path) -> None:
    dataset = Dataset.open(clean_bay)
    T = dataset.T_world_camera_true
    np.testing.assert_allclose(dataset.T_world_camera_measured, T, atol=1e-12)
    np.testing.assert_allclose(T[:, 2, 3], 3.0)
    np.testing.assert_allclose(T[:, 2, 2], -1.0)
    assert len(np.unique(T[:, 0, 3].round(9))) == 7 and len(np.unique(T[:, 1, 3].round(9))) == 3


def test_neighbours_overlap_enough(clean_bay: Path) -> None:
    dataset = Dataset.open(clean_bay)
    camera = dataset.sensor.camera
    assert camera is not None
    points = [world_points(dataset, k)[::50] for k in range(21)]

    def shared(i: int, j: int) -> float:
        T = inverse(dataset.T_world_camera_true[j])
        uv = camera.project(points[i] @ T[:3, :3].T + T[:3, 3])
        return float(
            np.mean(((uv >= 0) & (uv <= [camera.width - 1, camera.height - 1])).all(axis=1))
        )

    x, y = dataset.T_world_camera_true[:, :2, 3].T
    along = [shared(i, j) for i, j in pairwise(range(21)) if abs(y[i] - y[j]) < 0.1]
    across = [
        shared(i, j) for i in range(21) for j in range(21)
        if abs(x[i] - x[j]) < 0.1 and abs(y[i] - y[j]) == pytest.approx(2.0)
    ]  # fmt: skip
    assert len(along) == 18 and len(across) == 28
    assert 0.5 < np.mean(along) < 0.65 and min(along) > 0.45
    assert min(across) > 0.3


def test_depth_noise_is_what_the_header_says(clean_bay: Path, noisy_bay: Path) -> None:
    clean, noisy = Dataset.open(clean_bay), Dataset.open(noisy_bay)
    noise = noisy.sensor.noise
    assert clean.sensor.noise is None and noise is not None
    assert (noise.sigma_m, noise.at_m, noise.power, noise.along) == (0.00032, 3.0, 2.0, "z")
    z = np.array([frame.depth() for frame in clean], float)
    score = (np.array([frame.depth() for frame in noisy], float) - z) / noise.sigma(z)
    score = np.abs(score[np.isfinite(score)])
    assert 1.4826 * np.median(score) == pytest.approx(1.0, abs=0.05)
    assert np.percentile(score, 99) == pytest.approx(2.58, abs=0.2)  # few fly or graze


def test_white_noise_is_white(clean_bay: Path, tmp_path: Path) -> None:
    options = sim.GenerateOptions(seed=3, size=(320, 240), white=True, rgb=False)
    clean, noisy = (
        Dataset.open(clean_bay),
        Dataset.open(sim.generate("industrial-6", tmp_path / "white", options)),
    )
    noise = noisy.sensor.noise
    assert noise is not None
    assert (noise.sigma_m, noise.at_m, noise.power, noise.along) == (0.00032, 3.0, 2.0, "range")
    camera = SP1000.resized(320, 240).camera
    stretch = np.linalg.norm(camera.rays(), axis=-1)
    z = np.array([frame.depth() for frame in clean], float)
    error = (np.array([frame.depth() for frame in noisy], float) - z) * stretch
    score = (error / noise.sigma(z))[np.isfinite(error)]
    assert abs(score.mean()) < 0.005
    assert score.std() == pytest.approx(1.0, abs=0.01)  # counts of 0.05 mm add half a percent
    assert np.corrcoef(error[0].ravel(), error[1].ravel())[0, 1] == pytest.approx(0.0, abs=0.02)


def test_markers_are_seen_where_they_are(noisy_bay: Path, clean_bay: Path) -> None:
    dataset = Dataset.open(noisy_bay)
    markers = {marker.name: marker for marker in dataset.markers()}
    assert set(markers) == {"origin", "far_x", "far_y"}
    for name, place in (("origin", (0, 0)), ("far_x", (7, 0)), ("far_y", (0, 6))):
        np.testing.assert_allclose(markers[name].p_world[:2], place, atol=1e-9)
        assert len(markers[name].observations) >= 2
        for frame, p_camera in markers[name].observations:
            T = dataset.T_world_camera_true[frame]
            error = T[:3, :3] @ p_camera + T[:3, 3] - markers[name].p_world
            # Along, the noise of the mean over a disc of five pixels; across, what of it the rays
            # carry there, and nothing of the pixels' raster.
            assert np.linalg.norm(error[:2]) < 0.0001
            assert abs(error[2]) < 4 * 0.00032 / np.sqrt(10)
    before = {m.name: m for m in Dataset.open(clean_bay).markers()}["origin"].observations[0][1]
    assert not np.array_equal(before, markers["origin"].observations[0][1])  # noise included


def test_the_plate_lies_bedded_in_the_rubble(bay_model: mujoco.MjModel) -> None:
    data = mujoco.MjData(bay_model)
    mujoco.mj_kinematics(bay_model, data)
    plate = [k for k in range(bay_model.ngeom) if bay_model.geom(k).name.startswith("plate_")]
    up = data.geom_xmat[plate].reshape(-1, 3, 3)[:, 2, 2]
    assert np.degrees(np.arccos(up[0])) < 5.0
    assert len(plate) >= 6 and np.ptp(np.degrees(np.arccos(up))) > 2.0  # several planes
    scene = RayScene.of_model(bay_model)
    corner = data.geom_xpos[plate[0]] + data.geom_xmat[plate[0]].reshape(3, 3)[:, 1] * (
        bay_model.geom_size[plate[0], 1] - 0.05
    )
    hit = scene.cast(corner + np.array([0, 0, 1.0]), np.array([0, 0, -1.0]))
    assert int(hit.geom) == plate[0]


def test_the_rubble_is_stones_of_5_to_40_cm(bay_model: mujoco.MjModel) -> None:
    stones = bay_model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    assert 1000 < stones.sum() < 4000
    longest = []
    for mesh in np.unique(bay_model.geom_dataid[stones]):
        start, count = bay_model.mesh_vertadr[mesh], bay_model.mesh_vertnum[mesh]
        corners = bay_model.mesh_vert[start : start + count]
        longest.append(np.linalg.norm(corners[:, None] - corners, axis=2).max())
    assert min(longest) > 0.049
    assert 0.35 < max(longest) < 0.5


def test_every_frame_has_slopes_in_all_directions(clean_bay: Path) -> None:
    """What holds x, y and yaw: the share of steep ground, and no direction without it."""
    dataset = Dataset.open(clean_bay)
    for frame in dataset:
        p = np.full((240, 320, 3), np.nan)
        depth = frame.depth()
        p[np.isfinite(depth)] = frame.points()
        n = np.cross(np.diff(p, axis=1)[:-1], np.diff(p, axis=0)[:, :-1])
        slope = n[..., :2] / n[..., 2:]
        slope = slope[(np.abs(slope) < 1.5).all(axis=-1)]
        assert np.linalg.eigvalsh(np.cov(slope.T)).min() > 0.02


def test_fewer_frames_keep_the_spacing_and_more_make_it_denser() -> None:
    gantry = Gantry()
    whole, few, many = gantry.stations(), gantry.stations(6), gantry.stations(30)
    assert (len(whole), len(few), len(many)) == (21, 6, 30)
    np.testing.assert_allclose(few[0], whole[0])
    assert few[1, 0] - few[0, 0] == pytest.approx(whole[1, 0] - whole[0, 0])
    assert many[:, 0].max() == pytest.approx(7.0)
    steps = np.abs(np.diff(whole[:, :2], axis=0))
    assert (steps.min(axis=1) < 1e-9).all()  # a gantry drives along one axis at a time


def test_the_scene_depends_on_its_seed_alone(clean_bay: Path, noisy_bay: Path) -> None:
    text = (clean_bay / "scene" / "scene.xml").read_text()
    assert text == (noisy_bay / "scene" / "scene.xml").read_text()
    other = find_scene("industrial-6").build(4).to_xml()
    assert other != text and abs(len(other) - len(text)) < 0.1 * len(text)


def test_the_stored_scene_says_what_it_is(clean_bay: Path) -> None:
    stored = json.loads((clean_bay / "scene" / "scene.json").read_text())
    assert (stored["scene"], stored["seed"]) == ("industrial-6", 3)
    config = Dataset.open(clean_bay).header["source"]["config"]
    assert config["seed"] == 3 and config["clean"] is True
