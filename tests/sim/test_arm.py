from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from depthba import se3
from depthba.camera import Camera
from depthba.errors import OptionError
from depthba.kinematics import UR16E
from sim.engine import mujoco
from sim.errors import SimulationError
from sim.rendering.raycast import RayScene
from sim.rendering.tessellate import triangles_of
from sim.rigs import find_rig
from sim.rigs.arm import Arm
from sim.rigs.clearance import Clearance
from sim.rigs.planning import plan, shared_view
from sim.robots.ur16e import BASE, CAMERA, LINKS, T_FLANGE_CAMERA, add_ur16e
from sim.seeds import stream

BOX, SPHERE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
READY = np.array([-1.927, -1.584, 1.424, -1.41, -1.571, -0.356])
MARGIN = 0.02
UP = np.array([0.0, 0.0, 1.0])
COARSE = Camera(64, 36, 31.5 / np.tan(np.radians(50)), 17.5 / np.tan(np.radians(34)), 31.5, 17.5)


def bench(T_world_base: np.ndarray | None = None) -> mujoco.MjSpec:
    """The arm on its table, five boxes before it."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="table", type=BOX, size=[1.2, 0.6, 0.02], pos=[0, 0.4, -0.02])
    rng = stream(0, "bench")
    for _ in range(5):
        half = rng.uniform(0.02, 0.1, 3)
        place = [rng.uniform(-0.55, 0.55), rng.uniform(0.3, 0.8), half[2]]
        spec.worldbody.add_geom(type=BOX, size=half, pos=place)
    add_ur16e(spec, T_world_base)
    return spec


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """As a dataset stores it: through the text."""
    return mujoco.MjModel.from_xml_string(spec.to_xml())


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return compiled(bench())


@pytest.fixture(scope="module")
def planned(model: mujoco.MjModel):
    return Arm().plan(model, seed=1)


def moved(model: mujoco.MjModel, q: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:6] = q
    mujoco.mj_forward(model, data)
    return data


def of_arm(model: mujoco.MjModel) -> np.ndarray:
    """(ngeom,) whether a geom is the arm's."""
    names = (BASE, *LINKS, CAMERA)
    return np.array([model.body(int(b)).name in names for b in model.geom_bodyid])


def site(model: mujoco.MjModel, q: np.ndarray) -> np.ndarray:
    found = moved(model, q).site("flange")
    return se3.make(found.xmat.reshape(3, 3), found.xpos)


def test_mujoco_and_dh_put_the_flange_in_one_place(model: mujoco.MjModel) -> None:
    assert [model.joint(k).name for k in range(6)] == list(UR16E.joints)
    np.testing.assert_allclose(model.jnt_range.T, [UR16E.lower, UR16E.upper], atol=1e-5)
    for q in np.random.default_rng(0).uniform(-3.0, 3.0, (30, 6)):
        np.testing.assert_allclose(site(model, q), UR16E.forward(q), atol=1e-12)
    # The text has six digits: a slanted base and calibrated links are rounded to them.
    calibrated = UR16E.calibrated(a=1.234567e-4, d=-2.345678e-4, alpha=3.4567891e-4, theta=1.1e-4)
    T_world_base = se3.make(se3.exp_so3([0.1, 0.2, 0.3]), [0.123456789, 0.2, 0.3])
    spec = mujoco.MjSpec()
    add_ur16e(spec, T_world_base, dh=calibrated)
    assert (
        np.abs(site(compiled(spec), READY) - T_world_base @ calibrated.forward(READY)).max() < 1e-5
    )


def test_masses_are_the_published_ones(model: mujoco.MjModel) -> None:
    masses = [model.body(link).mass[0] for link in LINKS]
    np.testing.assert_allclose(masses, [7.369, 10.45, 4.321, 2.18, 2.033, 0.907])


def test_capsules_hold_all_that_is_visible(model: mujoco.MjModel) -> None:
    data, arm = moved(model, READY), of_arm(model)
    seen = triangles_of(model, data, (2,), 32)
    p = seen.vertices[np.unique(seen.faces[arm[seen.geom]])]
    outside = np.full(len(p), np.inf)
    for geom in np.flatnonzero(arm & (model.geom_group == 3)):
        (radius, half, _), axis = model.geom_size[geom], data.geom_xmat[geom][[2, 5, 8]]
        from_centre = p - data.geom_xpos[geom]
        along = np.clip(from_centre @ axis, -half, half)
        outside = np.minimum(
            outside, np.linalg.norm(from_centre - along[:, None] * axis, axis=1) - radius
        )
    assert outside.max() < 0.0


def test_the_camera_never_sees_itself_or_its_flange(model: mujoco.MjModel) -> None:
    data = moved(model, READY)
    T_camera_world = se3.inverse(UR16E.forward(READY) @ T_FLANGE_CAMERA)
    seen = triangles_of(model, data, (2,), 32)
    body = np.isin(model.geom_bodyid, [model.body(LINKS[-1]).id, model.body(CAMERA).id])
    p = seen.vertices[np.unique(seen.faces[body[seen.geom]])]
    assert (p @ T_camera_world[2, :3] + T_camera_world[2, 3]).max() < 0.0


def test_clearance_counts_what_is_only_visible_and_keeps_its_margin() -> None:
    ball = 0.03
    tip = moved(compiled(bench()), READY).site("flange").xpos - 0.2 * UP
    for gap, free in ((0.015, False), (0.025, True)):
        spec = bench()
        # Straight below the camera's bar, by the gap; and it would collide with nothing by itself.
        spec.worldbody.add_geom(
            name="ball", type=SPHERE, size=[ball, 0, 0], pos=tip, contype=0, conaffinity=0
        )
        found = compiled(spec)
        data = moved(found, READY)
        bar = next(
            g
            for g in np.flatnonzero(found.geom_group == 3)
            if found.geom_bodyid[g] == found.body(CAMERA).id
        )
        distance = mujoco.mj_geomDistance(found, data, bar, found.geom("ball").id, 1.0, None)
        spec.geom("ball").pos = tip + (distance - gap) * UP
        clearance = Clearance(compiled(spec), UR16E.joints, MARGIN)
        assert clearance.free(READY) == free, clearance.contacts(READY)


def test_poses_keep_clear_of_everything(model: mujoco.MjModel, planned) -> None:
    """Distances by another routine of MuJoCo, at the poses and between them."""
    arm = of_arm(model)
    solid = np.flatnonzero(arm & (model.geom_group == 3) & (model.geom_bodyid > 1))
    scene = np.flatnonzero(~arm)
    steps = [a + s * (b - a) for a, b in pairwise(planned.q) for s in np.linspace(0.0, 1.0, 8)]
    for number, q in enumerate(steps):
        data = moved(model, q)
        nearest = min(
            mujoco.mj_geomDistance(model, data, a, b, 0.5, None) for a in solid for b in scene
        )
        # The ends keep the margin; on the way half a step may go into it.
        assert nearest > (MARGIN if number % 8 in (0, 7) else 0.005) - 1e-9
        assert data.ncon == 0
    assert UR16E.within_limits(planned.q).all()
    assert UR16E.manipulability(planned.q).min() > 0.05


def test_no_frame_shows_the_arm(model: mujoco.MjModel, planned) -> None:
    arm = of_arm(model)
    for q, T in zip(planned.q, planned.T_world_camera, strict=True):
        hits = RayScene.of_model(model, moved(model, q), segments=24).view(COARSE, T)
        assert not arm[hits.geom[hits.geom >= 0]].any()
    # A camera before the table that looks back at the arm does see it.
    towards = se3.make([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]], [0.0, 1.4, 0.4])
    assert not Clearance(model, UR16E.joints).out_of_sight(planned.q[0], towards)


def test_the_dome_covers_the_work_area_and_frames_overlap(model: mujoco.MjModel, planned) -> None:
    T = planned.T_world_camera
    tilt = np.degrees(np.arccos(-T[:, 2, 2]))
    assert tilt.max() < 35.1 and np.ptp(tilt) > 10.0
    reach = (0.05 - T[:, 2, 3]) / T[:, 2, 2]
    assert reach.min() > 0.449 and reach.max() < 0.751
    gaze = T[:, :2, 3] + T[:, :2, 2] * reach[:, None]
    assert np.ptp(gaze[:, 0]) > 0.75 and np.ptp(gaze[:, 1]) > 0.25
    # Every place of the work area is in two frames or more, half of them in seven.
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 25), np.linspace(0.22, 0.85, 14))
    places = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    p = (places - T[:, None, :3, 3]) @ T[:, :3, :3]
    pixels = COARSE.project(p)
    seen = ((pixels >= -0.5) & (pixels <= [63.5, 35.5])).all(axis=-1)
    assert seen.sum(axis=0).min() >= 2 and np.median(seen.sum(axis=0)) >= 7
    # What the rays of one frame meet is in the frames beside it, by half or nearly: boxes bulge.
    views = RayScene.of_model(model, groups=(0,))
    for a, b in pairwise(T):
        for one, other in ((a, b), (b, a)):
            hits = views.view(COARSE, one)
            met = one[:3, 3] + (COARSE.rays() @ one[:3, :3].T) * hits.distance[..., None]
            pixels = COARSE.project((met[hits.geom >= 0] - other[:3, 3]) @ other[:3, :3])
            inside = ((pixels >= -0.5) & (pixels <= [63.5, 35.5])).all(axis=-1)
            assert inside.mean() > 0.45


def test_half_the_view_moved_by_half_its_width_is_shared() -> None:
    down = se3.make(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.6])
    half_width = 0.6 * np.tan(np.radians(50.0))
    aside = se3.retract(down, [half_width, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert shared_view(down, aside) == pytest.approx(0.5, abs=0.04)
    assert shared_view(down, down) == 1.0


def test_truth_is_the_forward_kinematics_and_no_error_moves_it(
    model: mujoco.MjModel, planned
) -> None:
    arm = Arm()
    track = arm.track_of(planned, model, seed=3)
    expected = planned.T_world_base @ UR16E.forward(track.qpos[:, :6]) @ T_FLANGE_CAMERA
    np.testing.assert_allclose(track.T_world_camera_true, expected, atol=1e-14)
    for scale in (0.0, 5.0):
        other = arm.track_of(planned, model, seed=3, scale=scale)
        np.testing.assert_array_equal(other.T_world_camera_true, track.T_world_camera_true)
        np.testing.assert_array_equal(other.qpos, track.qpos)
    assert (np.diff(track.stamps) >= 1.5).all()


def test_reports_agree_with_each_other(model: mujoco.MjModel, planned) -> None:
    track = Arm().track_of(planned, model, seed=3)
    np.testing.assert_allclose(UR16E.forward(track.joints), track.T_base_flange, atol=1e-12)
    np.testing.assert_allclose(
        track.T_base_flange @ track.T_flange_camera, track.T_world_camera, atol=1e-12
    )
    assert 0.0 < np.abs(track.joints - planned.q).max() < 0.003
    offset = se3.difference(track.T_flange_camera, track.T_flange_camera_true)
    assert 0.0 < np.linalg.norm(offset[:3]) < 0.01


def test_the_arm_believes_what_it_reports(model: mujoco.MjModel, planned) -> None:
    """Over many captures the errors are as large as the reported sigma says, axis by axis."""
    # The hand-eye error hides the joints': once without it.
    bare = replace(Arm().errors, hand_eye_t=0.0, hand_eye_r=0.0)
    for arm in (Arm(), Arm(errors=bare)):
        scores = []
        for seed in range(150):
            track = arm.track_of(planned, model, seed)
            delta = se3.difference(track.T_world_camera, track.T_world_camera_true)
            scores.append(delta / np.array([*track.sigma_t, *track.sigma_r]))
        rms = np.sqrt(np.mean(np.square(scores), axis=(0, 1)))
        assert ((rms > 0.75) & (rms < 1.25)).all(), rms


def test_errors_scale_and_vanish(model: mujoco.MjModel, planned) -> None:
    one, two, none = (Arm().track_of(planned, model, 4, scale=s) for s in (1.0, 2.0, 0.0))
    np.testing.assert_array_equal(none.T_world_camera, none.T_world_camera_true)
    np.testing.assert_array_equal(none.joints, planned.q)
    np.testing.assert_array_equal(none.T_base_flange, UR16E.forward(planned.q))
    assert none.sigma_t is None and none.T_flange_camera is not None
    moved = [se3.difference(t.T_world_camera, t.T_world_camera_true) for t in (one, two)]
    np.testing.assert_allclose(2.0 * moved[0], moved[1], atol=5e-4)
    np.testing.assert_allclose(np.multiply(2.0, one.sigma_t), two.sigma_t)


def test_a_start_error_replaces_the_reports(model: mujoco.MjModel, planned) -> None:
    track = Arm().track_of(planned, model, 5, start_error=(0.03, 0.02))
    np.testing.assert_array_equal(track.T_world_camera[0], track.T_world_camera_true[0])
    assert track.joints is None and track.T_base_flange is None
    assert track.qpos is not None and track.sigma_t == (0.03,) * 3


def test_equal_seeds_give_equal_captures(model: mujoco.MjModel) -> None:
    arm = find_rig("arm")
    one, again, other = (arm.track(model, seed, frames=3) for seed in (7, 7, 8))
    for name in ("stamps", "qpos", "joints", "T_world_camera", "T_world_camera_true"):
        assert getattr(one, name).tobytes() == getattr(again, name).tobytes()
    assert not np.allclose(one.qpos, other.qpos)
    assert one.qpos.shape == (3, model.nq)


def test_a_bare_arm_elsewhere_with_other_joints_beside_it() -> None:
    """A base that is not the world's origin, and a loose body that comes first in qpos."""
    spec = mujoco.MjSpec()
    loose = spec.worldbody.add_body(name="loose", pos=[3.0, 3.0, 0.0])
    loose.add_freejoint()
    loose.add_geom(type=BOX, size=[0.1, 0.1, 0.1])
    add_ur16e(spec, se3.make(se3.exp_so3([0.0, 0.0, 0.02]), [0.01, -0.02, 0.0]))
    model = compiled(spec)
    track = Arm().track(model, seed=2, frames=2)
    np.testing.assert_array_equal(track.qpos[:, :7], np.repeat(model.qpos0[None, :7], 2, axis=0))
    data = mujoco.MjData(model)
    data.qpos[:] = track.qpos[1]
    mujoco.mj_kinematics(model, data)
    flange = data.site("flange")
    T = se3.make(flange.xmat.reshape(3, 3), flange.xpos) @ T_FLANGE_CAMERA
    np.testing.assert_allclose(T, track.T_world_camera_true[1], atol=1e-9)


def test_wanted_poses_are_taken_in_order_one_of_each_stack(model: mujoco.MjModel, planned) -> None:
    T = planned.T_world_camera
    far = se3.make(np.diag([1.0, -1.0, -1.0]), [0.0, 3.0, 0.5])
    found = plan(model, iter([far, T[0], np.stack([far, T[1], T[2]]), T[3]]), 2)
    np.testing.assert_allclose(found.T_world_camera, T[:2], atol=1e-9)


def test_what_is_missing_is_said(model: mujoco.MjModel) -> None:
    spec = bench()
    # The work area is filled to above the camera's highest place.
    spec.worldbody.add_geom(type=BOX, size=[1.2, 0.4, 0.5], pos=[0.0, 0.6, 0.5])
    wanted = r"allows \d+ of 3 poses: of \d+ candidates .*\d+ in collision.*; expected more room"
    with pytest.raises(SimulationError, match=wanted):
        Arm().plan(compiled(spec), seed=0, frames=3)
    with pytest.raises(SimulationError, match="has no arm: shoulder_pan_joint"):
        Arm().plan(mujoco.MjModel.from_xml_string("<mujoco/>"), seed=0)
    with pytest.raises(OptionError, match="frames 0"):
        Arm().plan(model, seed=0, frames=0)
