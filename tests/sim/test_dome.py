from __future__ import annotations

from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest

from depthba import se3
from depthba.camera import Camera
from depthba.errors import OptionError
from sim.engine import mujoco
from sim.pictures import draw_scene
from sim.rendering.raycast import RayScene
from sim.rigs.dome import Dome, extent, look
from tests.sim.conftest import heap

CAMERA = Camera(96, 64, 70.0, 70.0, 47.5, 31.5)


def shifted(scale: float, at: tuple[float, float]) -> mujoco.MjModel:
    """Boxes of any size anywhere, on an endless floor."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
    for dx, dy in ((-1.0, -0.5), (1.0, 0.5), (0.3, -0.4)):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.1 * scale] * 3,
            pos=[at[0] + dx * scale, at[1] + dy * scale, 0.1 * scale],
        )
    return spec.compile()


@pytest.mark.parametrize(("scale", "at"), [(1.0, (0.0, 0.0)), (4.0, (20.0, -10.0))])
def test_the_dome_fits_itself_to_the_scene(scale: float, at: tuple[float, float]) -> None:
    model = shifted(scale, at)
    low, high = extent(model)
    np.testing.assert_allclose(high[:2] - low[:2], [2.2 * scale, 1.2 * scale], rtol=1e-6)
    T = Dome().track(model, seed=1).T_world_camera_true
    scene = RayScene.of_model(model)
    seen, footprints = set(), []
    for pose in T:
        hits = scene.view(CAMERA, pose)
        seen |= set(np.unique(hits.geom))
        points = pose[:3, 3] + np.einsum(
            "ij,hwj->hwi", pose[:3, :3], CAMERA.rays() * hits.distance[..., None]
        )
        inside = ((points >= low) & (points <= high))[..., :2].all(axis=-1)
        cell = np.floor((points[inside][:, :2] - low[:2]) / (0.2 * scale)).astype(int)
        footprints.append({tuple(c) for c in cell})
        assert np.degrees(np.arccos(-pose[2, 2])) < 30.1
    assert {1, 2, 3} <= seen
    # All is seen, most of it twice; and no frame stands alone.
    whole = set().union(*footprints)
    assert len(whole) >= 0.9 * 11 * 6
    counts = [sum(c in f for f in footprints) for c in whole]
    assert np.mean(np.array(counts) >= 2) > 0.8
    shared = [len(a & b) / min(len(a), len(b)) for a, b in combinations(footprints, 2)]
    assert max(shared) > 0.5


def test_reports_are_as_wrong_as_they_say() -> None:
    model = heap(0).compile()
    track = Dome(frames=400).track(model, seed=2)
    delta = se3.difference(track.T_world_camera, track.T_world_camera_true)
    np.testing.assert_allclose(delta.std(axis=0), np.repeat([0.005, 0.005], 3), rtol=0.15)
    assert track.sigma_t == (0.005,) * 3 and track.sigma_r == (0.005,) * 3
    clean = Dome().track(model, seed=2, scale=0.0)
    np.testing.assert_array_equal(clean.T_world_camera, clean.T_world_camera_true)
    with pytest.raises(OptionError, match="frames 0"):
        Dome().track(model, seed=0, frames=0)


def test_a_camera_looks_at_its_aim() -> None:
    rng = np.random.default_rng(0)
    for eye, at in rng.normal(size=(50, 2, 3)):
        T = look(eye, at)
        assert se3.is_rigid(T)
        np.testing.assert_allclose(
            T[:3, :3].T @ (at - eye) / np.linalg.norm(at - eye), [0, 0, 1], atol=1e-12
        )
    down = look(np.array([0, 0, 2.0]), np.zeros(3))
    np.testing.assert_allclose(down[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)


def test_a_scene_is_pictured(tmp_path: Path, quick_scene: str) -> None:
    pictures = [draw_scene(quick_scene, tmp_path / f"{k}.png") for k in range(2)]
    image = cv2.imread(str(pictures[0]))
    assert image is not None and image.shape[1] > 1000 and image.std() > 20
    assert pictures[0].read_bytes() == pictures[1].read_bytes()
