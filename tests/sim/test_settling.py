from __future__ import annotations

import numpy as np
import pytest

from sim.engine import mujoco
from sim.errors import SimulationError
from sim.markers import discs_of
from sim.rendering.raycast import RayScene
from sim.scenes import find_scene
from sim.scenes.relief import Relief
from sim.scenes.settling import Settling, settle
from sim.scenes.stones import CRUSHED, SLAG, draw_diameters, make_shapes, scatter
from sim.seeds import stream
from tests.sim.test_bays import steepest

FIXED = ("floor", "block", "marker_disc")


def heap(seed: int) -> mujoco.MjSpec:
    """Forty stones piled beside a block, sunk into the floor and into each other; and a marker."""
    spec = mujoco.MjSpec()
    world, kinds = spec.worldbody, mujoco.mjtGeom
    world.add_geom(name="floor", type=kinds.mjGEOM_BOX, size=[2, 2, 0.1], pos=[0, 0, -0.1])
    world.add_geom(name="block", type=kinds.mjGEOM_BOX, size=[0.3, 0.3, 0.1], pos=[0.6, 0, 0.1])
    world.add_geom(
        name="marker_disc", type=kinds.mjGEOM_CYLINDER, size=[0.025, 0.001, 0], pos=[-0.2, 0, 0.001]
    )
    rng = stream(seed, "heap")
    shapes = make_shapes(spec, rng, CRUSHED, np.array([0.07, 0.12]), 3)
    shapes += make_shapes(spec, rng, SLAG, np.array([0.07, 0.12]), 2)
    spec.add_material(name="slag")
    relief = Relief(np.zeros((161, 161)), (-2.0, -2.0), 0.025)
    diameters = draw_diameters(rng, 40, 0.06, 0.13, 1.7)
    scatter(spec, rng, relief, shapes, diameters, (-0.3, 0.3, -0.3, 0.3), repose=1.2)
    for name, place in (("under", [0.6, 0, 0.03]), ("edge", [2.02, 2.02, 0.0])):
        world.add_geom(
            name=f"loose_{name}", type=kinds.mjGEOM_MESH, meshname=shapes[0].mesh, pos=place
        )
    return spec


def contacts(spec: mujoco.MjSpec) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the deepest overlap and width of the narrowest gap of every loose geom, m."""
    spec = spec.copy()
    margin, bodies = 0.004, []
    for geom in list(spec.worldbody.geoms):
        if geom.name.startswith("loose_"):
            geom.contype = geom.conaffinity = 0
            body = spec.worldbody.add_body(pos=geom.pos, quat=geom.quat)
            body.add_freejoint()
            body.add_geom(type=geom.type, meshname=geom.meshname, size=geom.size, margin=margin)
            bodies.append(body)
    spec.memory = 1 << 29
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    nearest = np.full(model.nbody, margin)
    for contact in data.contact[: data.ncon]:
        for geom in contact.geom:
            body = model.geom_bodyid[geom]
            nearest[body] = min(nearest[body], contact.dist)
    found = nearest[[body.id for body in bodies]]
    return np.maximum(-found, 0.0), np.maximum(found, 0.0)


def poses(spec: mujoco.MjSpec) -> dict[str, np.ndarray]:
    return {geom.name: np.array([*geom.pos, *geom.quat]) for geom in spec.worldbody.geoms}


@pytest.fixture(scope="module")
def settled() -> mujoco.MjSpec:
    return settle(heap(1), Settling(layer=25))


def test_stones_lie_on_each_other_neither_sunk_nor_floating(settled: mujoco.MjSpec) -> None:
    before, _ = contacts(heap(1))
    assert np.sort(before)[-10:].min() > 0.01
    overlap, gap = contacts(settled)
    assert len(overlap) > 25
    assert overlap.max() < 0.005 and gap.max() < 0.002
    # and they would not move any further
    names = [name for name in poses(settled) if name.startswith("loose_")]
    again = poses(settle(settled))
    kept = [name for name in names if name in again]
    moved = [np.linalg.norm(again[name][:3] - poses(settled)[name][:3]) for name in kept]
    assert len(kept) >= len(names) - 1 and np.median(moved) < 0.005 and np.max(moved) < 0.1


def test_the_rest_stays_put_and_what_is_in_the_way_goes(settled: mujoco.MjSpec) -> None:
    before, after = poses(heap(1)), poses(settled)
    for name in FIXED:
        np.testing.assert_allclose(after[name], before[name], atol=1e-12)
    assert "loose_under" not in after and "loose_edge" not in after
    model = settled.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    assert model.nv == 0
    (disc,), rays = discs_of(model, data), RayScene.of_model(model, data)
    rng = stream(0, "onlookers")
    for _ in range(200):
        lean, way = np.radians(rng.uniform(0, 40)), rng.uniform(0, 2 * np.pi)
        towards = [np.sin(lean) * np.cos(way), np.sin(lean) * np.sin(way), np.cos(lean)]
        eye = disc.p_world + 3.0 * np.array(towards)
        around = rng.uniform(0, 2 * np.pi)
        point = disc.p_world + 0.02 * np.array([np.cos(around), np.sin(around), 0.0])
        assert int(rays.cast(eye, point - eye).geom) == disc.geom


def test_a_heap_keeps_its_angle_of_repose(settled: mujoco.MjSpec) -> None:
    stones = np.array([p[:3] for name, p in poses(settled).items() if name.startswith("loose_")])
    away = np.linalg.norm(stones[:, :2] - np.median(stones[:, :2], axis=0), axis=1)
    assert 0.05 < stones[:, 2].max() < np.tan(np.radians(40.0)) * np.percentile(away, 95)


def test_equal_scenes_settle_equally(settled: mujoco.MjSpec) -> None:
    again = settle(heap(1), Settling(layer=25))
    assert again.to_xml() == settled.to_xml()
    assert settle(heap(2), Settling(layer=25)).to_xml() != settled.to_xml()


def test_bodies_of_ones_own_come_to_rest_and_joints_stay() -> None:
    spec = mujoco.MjSpec()
    kinds = mujoco.mjtGeom
    spec.worldbody.add_geom(name="floor", type=kinds.mjGEOM_PLANE, size=[3, 3, 0.1])
    for k in range(7):  # a stack, and more than one layer of two
        body = spec.worldbody.add_body(name=f"crate_{k}", pos=[0.01 * k, 0, 0.2 + 0.25 * k])
        body.add_freejoint()
        body.add_geom(type=kinds.mjGEOM_BOX, size=[0.1, 0.1, 0.1], friction=[1, 0.005, 0.001])
        lid = body.add_body(name=f"lid_{k}", pos=[0, 0, 0.1])
        lid.add_geom(type=kinds.mjGEOM_BOX, size=[0.1, 0.1, 0.001])
    arm = spec.worldbody.add_body(name="arm", pos=[1, 0, 1])
    joint = arm.add_joint(name="shoulder", axis=[0, 1, 0])
    arm.add_geom(type=kinds.mjGEOM_CAPSULE, size=[0.03, 0.2, 0], pos=[0.2, 0, 0])
    spec.add_actuator(name="motor", target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    model = settle(spec, Settling(layer=2)).compile()
    assert (model.njnt, model.nu) == (1, 1) and model.joint("shoulder").id == 0
    for k in range(7):
        pose = model.body(f"crate_{k}")
        np.testing.assert_allclose(pose.pos, [0.01 * k, 0, 0.1 + 0.201 * k], atol=3e-3)
        assert pose.quat[0] > 0.9999
    np.testing.assert_allclose(model.body("arm").pos, [1, 0, 1])


def test_a_body_that_nothing_stops_is_named() -> None:
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="apple", pos=[0, 0, 1])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    with pytest.raises(SimulationError, match=r"'apple'.*expected something fixed under it"):
        settle(spec)


@pytest.mark.slow
@pytest.mark.parametrize("number", [5, 6])
def test_a_whole_bay_settles(number: int) -> None:
    entry = find_scene(f"industrial-{number}")
    bay = settle(entry.build(3))
    overlap, gap = contacts(bay)
    assert len(overlap) > 1100
    assert overlap.max() < 0.005 and gap.max() < 0.003
    model = bay.compile()
    for geom in range(model.ngeom):
        if model.geom(geom).name.startswith(("coil_", "strap_", "timber_")):
            model.geom_group[geom] = 5
    assert steepest(RayScene.of_model(model)) < 40.0
    before, after = poses(entry.build(3)), poses(bay)
    for name in after:
        if not name.startswith("loose_"):
            np.testing.assert_allclose(after[name], before[name], atol=1e-5)
