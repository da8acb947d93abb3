from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from depthba.camera import Camera
from sim.engine import mujoco
from sim.errors import SimulationError
from sim.raycast import RayScene

KINDS = mujoco.mjtGeom


def oracle(
    model: mujoco.MjModel, camera: Camera, T: np.ndarray, groups: tuple[int, ...] = (0, 1, 2)
) -> tuple[np.ndarray, np.ndarray]:
    """Depth and geom ids by MuJoCo's own rays; 0 and -1 where they meet nothing."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    directions = (camera.rays() @ T[:3, :3].T).reshape(-1, 3)
    length = np.linalg.norm(directions, axis=1)
    count = len(length)
    geom, distance = np.empty((count, 1), np.int32), np.empty((count, 1))
    group = np.array([g in groups for g in range(6)], np.uint8)
    mujoco.mj_multiRay(
        model, data, T[:3, 3].copy(), (directions / length[:, None]).reshape(-1, 1),
        group, 1, -1, geom, distance, None, count, 1e9,
    )  # fmt: skip
    shape = (camera.height, camera.width)
    depth = np.where(geom[:, 0] >= 0, distance[:, 0] / length, 0.0)
    return depth.reshape(shape), geom[:, 0].reshape(shape)


def inside(geom: np.ndarray) -> np.ndarray:
    """Pixels whose neighbours show the same geom: away from silhouettes."""
    return minimum_filter(geom, 3) == maximum_filter(geom, 3)


def zoo() -> mujoco.MjSpec:
    """One geom of each kind, turned any way, on a grid of 1 m."""
    spec, rng = mujoco.MjSpec(), np.random.default_rng(0)
    heights = rng.random((9, 12)).astype(np.float32)
    spec.add_hfield(
        name="hills", nrow=9, ncol=12, size=[0.4, 0.3, 0.2, 0.1], userdata=heights.ravel()
    )
    corners = rng.normal(size=(30, 3)) * 0.2
    spec.add_mesh(
        name="stone", uservert=corners.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    )
    kinds = [
        (KINDS.mjGEOM_BOX, [0.2, 0.3, 0.15]),
        (KINDS.mjGEOM_SPHERE, [0.3, 0, 0]),
        (KINDS.mjGEOM_CAPSULE, [0.12, 0.3, 0]),
        (KINDS.mjGEOM_CYLINDER, [0.2, 0.3, 0]),
        (KINDS.mjGEOM_ELLIPSOID, [0.35, 0.2, 0.1]),
        (KINDS.mjGEOM_HFIELD, [0, 0, 0]),
        (KINDS.mjGEOM_MESH, [0, 0, 0]),
    ]
    spec.worldbody.add_geom(type=KINDS.mjGEOM_PLANE, size=[0, 0, 0.1], pos=[0, 0, -0.4])
    for k, (kind, size) in enumerate(kinds):
        tilt = [0.1, -0.1] if kind == KINDS.mjGEOM_HFIELD else rng.normal(size=2)
        geom = spec.worldbody.add_geom(
            type=kind, size=size, pos=[k % 3 - 1, k // 3 - 1, 0], quat=[1, *tilt, 0.3]
        )
        if kind == KINDS.mjGEOM_HFIELD:
            geom.hfieldname = "hills"
        if kind == KINDS.mjGEOM_MESH:
            geom.meshname = "stone"
    return spec


def test_every_kind_of_geom_agrees_with_mujocos_own_rays() -> None:
    model = zoo().compile()
    camera = Camera(240, 180, 200.0, 200.0, 119.5, 89.5)
    T = np.eye(4)
    T[:3, :3] = np.array([[1, 0, 0], [0, -0.96, 0.28], [0, -0.28, -0.96]])
    T[:3, 3] = 0.0, -0.7, 2.6
    hits = RayScene.of_model(model).view(camera, T)
    depth, geom = oracle(model, camera, T)
    both = inside(geom) & (geom >= 0)
    np.testing.assert_array_equal(hits.geom[both], geom[both])
    for k in range(model.ngeom):
        here = both & (geom == k)
        assert here.sum() > 200, f"geom {k} is hardly in sight"
        error = np.abs(hits.distance - depth)[here]
        exact = KINDS(int(model.geom_type[k])) in (
            KINDS.mjGEOM_PLANE, KINDS.mjGEOM_BOX, KINDS.mjGEOM_MESH, KINDS.mjGEOM_HFIELD
        )  # fmt: skip
        # Round shapes are polygons: at their rims a ray hardly touches them.
        assert error.max() < (2e-6 if exact else 1e-4)
        assert np.quantile(error, 0.95) < 5e-5


def test_height_field_cells_are_split_as_mujoco_splits_them() -> None:
    spec = mujoco.MjSpec()
    saddle = np.array([0.0, 1.0, 1.0, 0.0], np.float32)
    spec.add_hfield(name="saddle", nrow=2, ncol=2, size=[1, 1, 0.5, 0.1], userdata=saddle)
    spec.worldbody.add_geom(type=KINDS.mjGEOM_HFIELD, hfieldname="saddle")
    model = spec.compile()
    camera = Camera(40, 40, 60.0, 60.0, 19.4, 19.7)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 3.5
    depth, _ = oracle(model, camera, T)
    distance = RayScene.of_model(model).view(camera, T).distance
    assert (depth > 0).mean() > 0.5
    np.testing.assert_allclose(np.nan_to_num(distance), depth, atol=1e-6)


def test_what_mujoco_does_not_draw_is_not_hit() -> None:
    spec = mujoco.MjSpec()
    for k, change in enumerate(({}, {"rgba": [1, 1, 1, 0]}, {"group": 3})):
        spec.worldbody.add_geom(
            type=KINDS.mjGEOM_BOX, size=[0.1, 0.1, 0.1], pos=[k - 1.0, 0, 0], **change
        )
    hits = RayScene.of_model(spec.compile()).cast(
        np.array([[-1.0, 0, 2], [0, 0, 2], [1, 0, 2]]), np.array([[0, 0, -1.0]] * 3)
    )
    np.testing.assert_array_equal(hits.geom, [0, -1, -1])
    np.testing.assert_allclose(hits.distance, [1.9, np.nan, np.nan])


def test_a_scene_with_nothing_to_see_is_refused() -> None:
    with pytest.raises(SimulationError, match="no visible geom"):
        RayScene.of_model(mujoco.MjSpec().compile())


def test_shadows_are_where_something_stands_in_the_way() -> None:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=KINDS.mjGEOM_PLANE, size=[2, 2, 0.1])
    spec.worldbody.add_geom(type=KINDS.mjGEOM_BOX, size=[0.2, 0.2, 0.2], pos=[0, 0, 1])
    scene = RayScene.of_model(spec.compile())
    points = np.array([[0.0, 0, 0.001], [1.0, 0, 0.001]])
    np.testing.assert_array_equal(scene.blocked(points, np.array([0, 0, 1.0])), [True, False])
    np.testing.assert_array_equal(scene.blocked(points, np.array([-1.0, 0, 1.0])), [False, True])


def test_the_bay_agrees_with_mujocos_own_rays(bay_model: mujoco.MjModel) -> None:
    camera = Camera(64, 48, 55.4, 55.4, 31.5, 23.5)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = 3.5, 3.0, 3.0
    hits = RayScene.of_model(bay_model).view(camera, T)
    depth, geom = oracle(bay_model, camera, T)
    same = hits.geom == geom
    assert same.mean() > 0.995  # a ray along an edge may fall on either side
    assert np.abs(hits.distance - depth)[same].max() < 5e-5
