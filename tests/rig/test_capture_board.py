"""A session that looks at a calibration board: which views it takes, and what they are worth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from depthba import se3
from depthba.boards import Board
from depthba.camera import Camera
from depthba.cli import main
from depthba.dataset import Dataset, verify
from depthba.errors import OptionError, OutOfReach
from depthba.kinematics import UR16E
from depthba.ur_outline import LINKS, in_view
from rig.session.aims import board_pose
from rig.session.carriers import make_carrier
from rig.session.planning import Plan, plan
from rig.session.reading import read_session
from rig.session.workspace import Workspace
from sim.rigs.clearance import Clearance
from sim.robots.ur16e import T_FLANGE_CAMERA
from sim.scenes import find_scene
from sim.sensors import ZED2
from tests.rig.sessions import ROOT, STATIONS, command, finished, write
from tests.sim.controllers import READY

CAMERA = ZED2.camera
BOARD = {"board": "10x7x0.03", "at": [0.0, 0.6, 0.08], "slack": 0.03, "count": 12}
BOX = [-0.8, 0.8, 0.15, 1.1, 0.3, 1.0]


def planned(tmp_path: Path, camera: Camera = CAMERA, **changes: Any) -> tuple[Workspace, Plan]:
    changes = {"limits__camera": BOX, "motion__rest": list(READY), **changes}
    session = read_session(write(tmp_path / "s.yaml", **changes))
    space = Workspace.of(session, make_carrier(session.rig, session.motion).body)
    return space, plan(session, space, np.array(READY), lambda: camera)


def test_views_of_a_board_hold_it_wherever_it_lies_within_the_slack(tmp_path: Path) -> None:
    space, found = planned(tmp_path, poses=[{"calibration": {**BOARD, "turn_deg": 20}}])
    assert len(found.joints) == 12 and found.left_out == ()
    aim = read_session(tmp_path / "s.yaml").poses[0].calibration
    assert aim is not None
    T_world_board = board_pose(aim)
    np.testing.assert_allclose(T_world_board[:3, 2], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(
        T_world_board[:3, 0], [np.cos(np.radians(20)), np.sin(np.radians(20)), 0], atol=1e-12
    )
    sheet = Board().sheet()
    tilts = []
    for q, T in zip(found.joints, found.T_world_camera, strict=True):
        assert space.why_not(q) is None
        assert in_view(UR16E, q, space.T_flange_camera, CAMERA) is None
        # The board pushed to every side by as much as it may be off, in its own plane.
        for push in ([0.03, 0, 0], [-0.03, 0, 0], [0, 0.03, 0], [0, -0.03, 0]):
            world = (sheet + push) @ T_world_board[:3, :3].T + T_world_board[:3, 3]
            pixels = CAMERA.project((world - T[:3, 3]) @ T[:3, :3])
            assert (pixels >= 0).all() and (pixels <= [CAMERA.width, CAMERA.height]).all()
        tilts.append(np.degrees(np.arccos(-T[2, 2])))
    # From all sides, or X stays open.
    assert max(tilts) > 30 and np.ptp(tilts) > 15
    towards = np.array([T[:2, 3] - [0.0, 0.6] for T in found.T_world_camera])
    turned = np.sort(np.arctan2(towards[:, 1], towards[:, 0]))
    assert np.diff([*turned, turned[0] + 2 * np.pi]).max() < np.radians(120)


def test_a_board_that_cannot_be_seen_is_refused_with_reasons(tmp_path: Path) -> None:
    away = {**BOARD, "at": [0.0, 2.0, 0.0]}
    with pytest.raises(OutOfReach, match=r"0 of 12 views .* x out of reach"):
        planned(tmp_path, poses=[{"calibration": away}])
    with pytest.raises(OptionError, match="expected one that fits the image"):
        narrow = replace(CAMERA, fx=4000.0, fy=4000.0)
        planned(tmp_path, narrow, poses=[{"calibration": BOARD}])
    for wrong, said in (
        ({"board": "10x7"}, "expected inner corners"),
        ({"count": 2}, "expected 3 or more"),
        ({"tilt_deg": [40, 6]}, "expected least and largest"),
        ({"facing": [0, 0, 0]}, "expected a direction"),
    ):
        with pytest.raises(OptionError, match=said):
            planned(tmp_path, poses=[{"calibration": {**BOARD, **wrong}}])
    two = [{"calibration": BOARD}, {"calibration": {**BOARD, "board": "9x6x0.02"}}]
    with pytest.raises(OptionError, match="expected one"):
        planned(tmp_path, poses=two)


def test_the_arm_in_its_own_view_is_told_before_anything_moves(tmp_path: Path) -> None:
    # The camera bolted on so that it looks back along the arm.
    back = se3.make(se3.exp_so3([np.pi, 0.0, 0.0]), [0.0, 0.0, 0.05]).tolist()
    changes: dict[str, Any] = {"hand_eye": back, "poses": [{"joints": STATIONS}]}
    with pytest.raises(OutOfReach, match=r"joints 0.*: the arm's .* stands in the camera's view"):
        planned(tmp_path, **changes)
    _, found = planned(tmp_path, **changes, limits__arm_in_view="allow")
    assert len(found.joints) == 3
    _, found = planned(tmp_path, poses=[{"joints": STATIONS}])
    assert len(found.joints) == 3


def test_the_arm_is_in_view_where_the_simulation_says_so() -> None:
    rng = np.random.default_rng(5)
    model = find_scene("lab-1").build(0).compile()
    view = (2 * np.arctan(0.5 * CAMERA.width / CAMERA.fx),
            2 * np.arctan(0.5 * CAMERA.height / CAMERA.fy))  # fmt: skip
    clearance = Clearance(model, UR16E.joints, view=view)
    said: list[bool] = []
    for _ in range(200):
        q = rng.uniform(-2.5, 2.5, 6)
        T = clearance.T_world_base @ UR16E.forward(q) @ T_FLANGE_CAMERA
        part = in_view(UR16E, q, T_FLANGE_CAMERA, CAMERA)
        assert (part is None) == clearance.out_of_sight(q, T)
        assert part is None or part in LINKS[:-1]
        said.append(part is None)
    assert 20 < sum(said) < 180


@pytest.mark.slow
def test_a_rehearsed_plan_calibrates(tmp_path: Path) -> None:
    pytest.importorskip("rtde_control")
    path = ROOT / "docs" / "sessions" / "calibration.yaml"
    content = yaml.safe_load(path.read_text())
    out, run = tmp_path / "out", tmp_path / "run"
    status, _, error = finished(command(path, "--out", out, "--rehearse", "--speed", "10"))
    assert status == 0, error
    assert verify(out) == []
    dataset = Dataset.open(out)
    assert len(dataset) == content["poses"][0]["calibration"]["count"]
    assert dataset.calibration() == {"board": Board().json()}
    assert main(["calibrate", str(out), "--out", str(run)]) == 0
    found = json.loads((run / "hand_eye.json").read_text())
    delta = se3.difference(np.array(found["T_flange_camera"]), T_FLANGE_CAMERA)
    assert np.degrees(np.linalg.norm(delta[3:])) <= 0.05
    assert np.linalg.norm(delta[:3]) <= 0.00025
