from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from depthba.camera import Camera
from sim.engine import mujoco
from sim.errors import SimulationError
from sim.rendering import embree
from sim.rendering.raycast import RayScene, world_rays

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


def slanted() -> np.ndarray:
    """T_world_camera that has the whole zoo in sight."""
    T = np.eye(4)
    T[:3, :3] = np.array([[1, 0, 0], [0, -0.96, 0.28], [0, -0.28, -0.96]])
    T[:3, 3] = 0.0, -0.7, 2.6
    return T


def grazing() -> np.ndarray:
    """T_world_camera that looks along the ground."""
    T = np.eye(4)
    T[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    T[:3, 3] = 0.2, -3.0, 0.1
    return T


def test_every_kind_of_geom_agrees_with_mujocos_own_rays() -> None:
    model = zoo().compile()
    camera = Camera(240, 180, 200.0, 200.0, 119.5, 89.5)
    T = slanted()
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
    each = np.array([[-1.0, 0, 1.0], [-1.0, 0, 1.0]])
    np.testing.assert_array_equal(scene.blocked(points, each), [False, True])
    np.testing.assert_array_equal(scene.blocked(points, each, np.array([9.0, 0.5])), [False] * 2)
    np.testing.assert_array_equal(scene.blocked(np.full((1, 3), np.nan), each[0]), [False])


def test_what_a_camera_sees_is_visible_from_there_and_not_through_a_box() -> None:
    scene = RayScene.of_model(zoo().compile())
    camera = Camera(161, 121, 140.0, 140.0, 80.0, 60.0)
    for T in (slanted(), grazing()):
        distance = scene.view(camera, T).distance
        points = T[:3, 3] + world_rays(camera, T) * distance[..., None]
        seen = scene.visible_from(points, T[:3, 3])
        np.testing.assert_array_equal(seen, np.isfinite(distance))  # no acne, NaN is unseen
        aside = T[:3, 3] + [0.4, 0.1, 0.0]
        hits = scene.cast(aside, points - aside)
        clear = np.abs(hits.distance - 1.0)
        sure = np.isfinite(distance) & ((clear < 1e-6) | (clear > 1e-3))
        np.testing.assert_array_equal(scene.visible_from(points, aside)[sure], (clear < 1e-6)[sure])


def test_incidence_and_normals_of_a_slope() -> None:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(
        type=KINDS.mjGEOM_BOX, size=[0.5, 0.5, 0.01], quat=[np.cos(0.3), np.sin(0.3), 0, 0]
    )
    scene = RayScene.of_model(spec.compile())
    camera, T = Camera(41, 31, 30.0, 30.0, 20.0, 15.0), np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 2.0
    hits = scene.view(camera, T)
    cosine = scene.incidence(camera, T, hits)
    normal = np.array([0.0, -np.sin(0.6), np.cos(0.6)])
    assert cosine[15, 20] == pytest.approx(np.cos(0.6), abs=1e-12)
    ray = T[:3, :3] @ camera.rays()[18, 23]
    assert cosine[18, 23] == pytest.approx(abs(ray @ normal) / np.linalg.norm(ray), abs=1e-12)
    np.testing.assert_allclose(scene.normals_of(hits)[15, 20], normal, atol=1e-12)
    in_camera = scene.normals_of(hits, T)[15, 20]
    np.testing.assert_allclose(in_camera, normal * [1, -1, -1], atol=1e-12)
    np.testing.assert_array_equal(np.isnan(cosine), hits.triangle < 0)
    np.testing.assert_array_equal(np.isnan(scene.normals_of(hits)[..., 0]), hits.triangle < 0)


def test_packets_find_what_single_rays_find() -> None:
    scene = RayScene.of_model(zoo().compile())
    triangles = scene.triangles
    single = embree.Singles(triangles.vertices.astype("f4"), triangles.faces.astype("i4"))
    camera, T = Camera(161, 121, 140.0, 140.0, 80.0, 60.0), slanted()  # no multiple of four
    hits = scene.view(camera, T)
    rays = world_rays(camera, T).reshape(-1, 3)
    eye = T[None, :3, 3].astype(np.float32)
    alone = single.first(eye, rays.astype(np.float32)).reshape(hits.triangle.shape)
    assert (alone == hits.triangle).mean() > 0.999  # on an edge it may be either
    np.testing.assert_array_equal(
        hits.triangle, scene.cast(T[:3, 3], rays).triangle.reshape(121, -1)
    )
    points = (T[:3, 3] + rays * hits.distance.reshape(-1, 1) * 0.99999).astype(np.float32)
    lamp, reach = np.array([[0.4, -0.3, 0.6]], np.float32), np.array([0.5], np.float32)
    both = [caster.blocked(points, lamp, reach) for caster in (single, scene._embree)]
    assert 0.02 < both[0].mean() < 0.5
    assert (both[0] == both[1]).mean() > 0.999


def test_no_ray_slips_between_the_cells_of_a_height_field() -> None:
    spec, rng = mujoco.MjSpec(), np.random.default_rng(1)
    heights = rng.random((400, 400)).astype(np.float32)
    spec.add_hfield(name="g", nrow=400, ncol=400, size=[2, 2, 0.1, 0.1], userdata=heights.ravel())
    spec.worldbody.add_geom(type=KINDS.mjGEOM_HFIELD, hfieldname="g")
    camera, T = Camera(800, 600, 800.0, 800.0, 399.5, 299.5), np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 3.0
    distance = RayScene.of_model(spec.compile()).view(camera, T).distance
    assert distance.max() < 3.0  # neither through it nor onto its base
    assert distance.min() > 2.89


def test_another_pose_of_the_joints_reuses_the_shapes() -> None:
    spec = zoo()
    arm = spec.worldbody.add_body(pos=[0, 0, 0.3])
    arm.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.3, 0.2, 1])
    arm.add_geom(type=KINDS.mjGEOM_CAPSULE, size=[0.05, 0.4, 0], quat=[1, 1, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[0] = 1.1
    mujoco.mj_kinematics(model, data)
    moved, fresh = RayScene.of_model(model).at(data), RayScene.of_model(model, data)
    for name in ("vertices", "faces", "geom", "curved", "corner_normals"):
        theirs = getattr(fresh.triangles, name)
        np.testing.assert_array_equal(getattr(moved.triangles, name), theirs)
    with pytest.raises(SimulationError, match="bare triangles"):
        RayScene(fresh.triangles).at(data)


def test_the_bay_agrees_with_mujocos_own_rays(bay_model: mujoco.MjModel) -> None:
    camera = Camera(64, 48, 55.4, 55.4, 31.5, 23.5)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = 3.5, 3.0, 3.0
    hits = RayScene.of_model(bay_model).view(camera, T)
    depth, geom = oracle(bay_model, camera, T)
    same = hits.geom == geom
    assert same.mean() > 0.995  # a ray along an edge may fall on either side
    assert np.abs(hits.distance - depth)[same].max() < 5e-5
