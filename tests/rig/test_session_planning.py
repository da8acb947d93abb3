"""From wishes to joints in order: reached exactly, within all limits on the way too, and short."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from depthba import se3
from depthba.errors import OutOfReach
from depthba.kinematics import UR16E
from rig.session.aims import dome_poses, facing, grid_poses, look_pose, step_positions
from rig.session.carriers import make_carrier
from rig.session.options import Session
from rig.session.planning import Plan, plan
from rig.session.poses import Dome, Grid, Look, Steps
from rig.session.reading import read_session
from rig.session.record import as_stored, differences
from rig.session.workspace import Workspace
from tests.rig.sessions import ROOT, STATIONS, write
from tests.sim.controllers import READY

GRID = {"x": [-0.3, 0.3], "y": [0.4, 0.58], "z": 0.05, "counts": [5, 4], "distance": [0.42, 0.5],
        "tilt_deg": 10, "roll_deg": 10, "yaw_deg": 30}  # fmt: skip


def planned(tmp_path: Path, **changes: Any) -> tuple[Session, Workspace, Plan]:
    session = read_session(write(tmp_path / "s.yaml", **changes))
    space = Workspace.of(session, make_carrier(session.rig, session.motion).body)
    return session, space, plan(session, space, np.array(READY))


def test_a_camera_faces_what_it_looks_at(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    directions = rng.standard_normal((50, 3))
    R = facing(directions, rng.uniform(-3, 3, 50))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(R[..., 2], unit, atol=1e-12)
    assert se3.is_rigid(se3.make(R, np.zeros(3)), 1e-12)
    np.testing.assert_allclose(facing([0, 0, -1]), np.diag([1, -1, -1]), atol=1e-15)
    assert se3.is_rigid(se3.make(facing([0, 0, 1]), np.zeros(3)), 1e-12)
    T = look_pose(Look((0.1, 0.2, 0.9), (0.3, 0.5, 0.0), 25.0))
    p = se3.inverse(T) @ [0.3, 0.5, 0.0, 1.0]
    np.testing.assert_allclose(p[:2], 0.0, atol=1e-12)


def test_grids_and_domes_look_at_their_points_from_their_distances() -> None:
    grid = Grid((-0.4, 0.4), (0.3, 0.6), (3, 2), (0.5, 0.6), z=0.1, tilt_deg=15.0, roll_deg=5.0)
    T = grid_poses(grid)
    reach = (0.1 - T[:, 2, 3]) / T[:, 2, 2]
    np.testing.assert_allclose(reach, [0.5, 0.6] * 3)
    gaze = T[:, :3, 3] + reach[:, None] * T[:, :3, 2]
    expected = [(-0.4, 0.3), (0, 0.3), (0.4, 0.3), (0.4, 0.6), (0, 0.6), (-0.4, 0.6)]
    np.testing.assert_allclose(gaze[:, :2], expected, atol=1e-12)
    np.testing.assert_allclose(T[:, 2, 2], -np.cos(np.radians(15.0)))
    dome = Dome((0.1, 0.5, 0.0), 0.7, (0.0, 30.0), (1, 4), roll_deg=10.0)
    T = dome_poses(dome)
    np.testing.assert_allclose(T[:, :3, 3] + 0.7 * T[:, :3, 2], [[0.1, 0.5, 0.0]] * 5, atol=1e-12)
    np.testing.assert_allclose(T[1:, 2, 3], 0.7 * np.cos(np.radians(30.0)))
    np.testing.assert_allclose(T[1:, :3, 3].mean(axis=0)[:2], [0.1, 0.5], atol=1e-12)


def test_a_gantry_goes_to_and_fro() -> None:
    found = step_positions(Steps((0.0, 1.0), (1.0, 3.0), (2, 3)))
    np.testing.assert_array_equal(found, [[0, 1], [1, 1], [1, 2], [0, 2], [0, 3], [1, 3]])
    path = ROOT / "docs" / "sessions" / "gantry_genicam.yaml"
    session = read_session(path)
    space = Workspace.of(session, make_carrier(session.rig, session.motion).body)
    found_plan = plan(session, space, np.array([0.0, 1.0]))
    # As sim's gantry does it: over the bay at 3 m, straight down, the image's x along world y.
    assert len(found_plan.joints) == 21
    np.testing.assert_allclose(found_plan.T_world_camera[:, :2, 3], found_plan.joints, atol=1e-12)
    np.testing.assert_allclose(found_plan.T_world_camera[:, 2, 3], 3.0)
    assert found_plan.length == pytest.approx(6 * 3 * 7 / 6 + 2 * 2)


def test_a_plan_takes_every_pose_exactly_within_the_limits_on_a_short_way(tmp_path: Path) -> None:
    session, space, found = planned(tmp_path, poses=[{"grid": GRID}])
    wanted = grid_poses(session.poses[0].grid or Grid((0, 0), (0, 0), (1, 1), 1.0))
    assert sorted(found.labels) == sorted(f"grid {k}" for k in range(20))
    rows = [int(label.split()[1]) for label in found.labels]
    np.testing.assert_allclose(found.T_world_camera, wanted[rows], atol=1e-9)
    here = np.array(READY)
    box = np.array(session.limits.camera)
    for q in found.joints:
        way = here + np.linspace(0, 1, 200)[:, None] * (q - here)
        p = space.camera_at(way)[:, :3, 3]
        assert (p >= box[::2] - 1e-3).all() and (p <= box[1::2] + 1e-3).all()
        here = q
    assert UR16E.within_limits(found.joints).all()
    _, _, given = planned(tmp_path, poses=[{"grid": GRID}], order="given")
    assert [int(label.split()[1]) for label in given.labels] == list(range(20))
    assert found.length < 0.8 * given.length
    again = planned(tmp_path, poses=[{"grid": GRID}])[2]
    np.testing.assert_array_equal(again.joints, found.joints)


def test_all_poses_that_cannot_be_taken_are_told_at_once(tmp_path: Path) -> None:
    poses = [
        {"camera": [{"at": [0.0, 1.4, 0.5], "towards": [0.0, 1.4, 0.0]}]},
        {"joints": [[7.0, 0, 0, 0, 0, 0], [-1.9, -1.0, 1.4, -1.9, -1.57, -0.36], *STATIONS]},
        {"camera": [{"at": [0.0, 0.55, 0.3], "towards": [0.0, 0.55, 0.0]}]},
    ]
    with pytest.raises(OutOfReach) as caught:
        planned(tmp_path, poses=poses)
    said = str(caught.value)
    assert said.startswith("4 of 7 poses cannot be taken")
    for part in (
        "camera 0 of poses[0]: out of reach",
        "joints 0 of poses[1]: shoulder_pan_joint 7 rad, expected -6.283 to 6.283",
        "joints 1 of poses[1]: camera z",
        "camera 0 of poses[2]: camera z 0.300 m, expected 0.35 to 0.9 m (limits.camera)",
    ):
        assert part in said, said
    found = planned(tmp_path, poses=poses, unreachable="leave out")[2]
    np.testing.assert_array_equal(found.joints, STATIONS)
    assert len(found.left_out) == 4
    with pytest.raises(OutOfReach, match=r"joints 2: elbow_joint 1\.424 rad, expected 1\.5 to"):
        planned(tmp_path, limits__lower=[-6, -6, 1.5, -6, -6, -6])


def test_a_way_that_leaves_the_limits_leads_over_the_rest_or_is_refused(tmp_path: Path) -> None:
    # Half a turn of the pan: between the two the camera passes where it must not.
    left, right = [READY[0] + 1.2, *READY[1:]], [READY[0] - 1.2, *READY[1:]]
    limits = {"limits__camera": [-0.8, 0.8, 0.1, 0.5, 0.35, 0.9], "order": "given"}
    poses = [{"joints": [left, right]}]
    session = read_session(write(tmp_path / "s.yaml", poses=poses, **limits))
    space = Workspace.of(session, make_carrier(session.rig, session.motion).body)
    with pytest.raises(
        OutOfReach, match=r"1 of 2 .*joints 1: no way from the pose before: camera y"
    ):
        plan(session, space, np.array(left))
    folded = [READY[0], -1.9, 2.2, -1.87, -1.571, -0.356]
    session = dataclasses.replace(
        session, motion=dataclasses.replace(session.motion, rest=tuple(folded))
    )
    space = Workspace.of(session, make_carrier(session.rig, session.motion).body)
    legs, reason = space.way(np.array(left), np.array(right))
    assert reason is None and len(legs) == 2
    np.testing.assert_array_equal(legs[0], folded)


def test_straight_moves_are_looked_at_as_straight(tmp_path: Path) -> None:
    _, space, found = planned(tmp_path, motion__move="linear", motion__speed=0.2)
    assert len(found.joints) == 3
    far = np.array([READY[0] + 3.1, *READY[1:]])
    assert "straight line" in (space.why_no_way(np.array(READY), far) or "")


def test_kinematics_belong_to_what_a_resume_compares(tmp_path: Path) -> None:
    session, space, _ = planned(tmp_path)
    dh = UR16E.calibrated(d=1e-4)
    other = dataclasses.replace(space, body=dataclasses.replace(space.body, arm=dh))
    before, now = as_stored(session, space, True), as_stored(session, other, True)
    assert [line.split(":")[0] for line in differences(before, now)][:1] == ["kinematics.d[0]"]
