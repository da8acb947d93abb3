"""The board scenes: what OpenCV makes of their images is the truth that calibration.json states."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import sim
from depthba import se3
from depthba.board_views import Views
from depthba.boards import Board
from depthba.dataset import Dataset, verify
from depthba.errors import OptionError
from sim import calibration
from sim.engine import mujoco
from sim.errors import SimulationError
from sim.rigs.board_arm import BoardArm
from sim.rigs.track import Track
from sim.scenes import SCENES
from sim.scenes.board import add_print
from sim.seeds import stream
from sim.sensors import ZED2
from sim.world import World

FRAMES = 4
T_WORLD_BOARD = se3.make(se3.exp_so3([2.9, 0.3, -0.2]), [0.1, 0.6, 0.15])


@pytest.fixture(scope="module", params=["handeye-board", "handeye-charuco"])
def capture(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    options = sim.GenerateOptions(seed=2, frames=FRAMES, clean=True)
    path = sim.generate(request.param, tmp_path_factory.mktemp("capture") / "set", options)
    assert verify(path) == []
    return Dataset.open(path)


def solve_pose(
    board: Board, ids: NDArray[np.int64], pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """T_camera_board (4, 4) by OpenCV."""
    points, K = board.corners()[ids], ZED2.camera.matrix
    _, r, t = cv2.solvePnP(points, pixels, K, None)
    r, t = cv2.solvePnPRefineLM(points, pixels, K, None, r, t)
    return se3.make(se3.exp_so3(r.ravel()), t.ravel())


def test_what_opencv_sees_closes_on_the_truth(capture: Dataset) -> None:
    truth = capture.calibration()
    assert truth is not None
    board = Board.from_json(truth["board"])
    X, T_base_board = (
        np.array(truth[key]) for key in ("T_flange_camera_true", "T_base_board_true")
    )
    T_base_flange, T_camera_board = [], []
    for frame, T_world_camera in zip(capture, capture.T_world_camera_true, strict=True):
        image = frame.rgb()
        assert image is not None and image.shape == (720, 1280, 3)
        ids, pixels = board.detect(image)
        assert len(ids) == 70
        # The world is the arm's base.
        T = se3.inverse(T_world_camera) @ T_base_board
        error = pixels - ZED2.camera.project(board.corners() @ T[:3, :3].T + T[:3, 3])
        assert np.sqrt(np.square(error).sum(axis=1).mean()) < 0.06
        T_camera_board.append(solve_pose(board, ids, pixels))
        assert frame.T_base_flange is not None
        T_base_flange.append(frame.T_base_flange)
        closed = se3.difference(T_base_flange[-1] @ X @ T_camera_board[-1], T_base_board)
        assert np.linalg.norm(closed[:3]) < 3e-4 and np.linalg.norm(closed[3:]) < 5e-4
    A, B = np.array(T_base_flange), np.array(T_camera_board)
    R, t = cv2.calibrateHandEye(
        A[:, :3, :3], A[:, :3, 3], B[:, :3, :3], B[:, :3, 3], method=cv2.CALIB_HAND_EYE_PARK
    )
    found = se3.difference(se3.make(R, t.ravel()), X)
    assert np.linalg.norm(found[:3]) < 3e-4 and np.linalg.norm(found[3:]) < 5e-4


def test_the_arm_looks_from_all_sides_and_nothing_hides_the_board() -> None:
    world = World.build(SCENES["handeye-board"], 5)
    track = BoardArm().track(world.model, 5, frames=6)
    found = calibration.board_of(world.model, world.at().data)
    assert found is not None and track.qpos is not None and track.T_flange_camera_true is not None
    board, T_world_board = found
    sheet = np.concatenate([board.corners(), 0.99 * board.sheet()])
    points = sheet @ T_world_board[:3, :3].T + T_world_board[:3, 3]
    for T_world_camera, qpos in zip(track.T_world_camera_true, track.qpos, strict=True):
        hits = world.at(qpos).rays.cast(T_world_camera[:3, 3], points - T_world_camera[:3, 3])
        assert {world.model.geom(geom).name for geom in hits.geom} == {"print"}
        np.testing.assert_allclose(hits.distance, 1.0, atol=1e-6)
    assert spread(track.T_world_camera_true).min() > 0.15
    for frame in (0, 5):
        data = world.at(track.qpos[frame]).data
        flange = world.model.site("flange").id
        T = se3.make(data.site_xmat[flange].reshape(3, 3), data.site_xpos[flange])
        np.testing.assert_allclose(
            T @ track.T_flange_camera_true, track.T_world_camera_true[frame], atol=1e-5
        )


def spread(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean squares (3,) of the rotations between poses along their principal axes, rad."""
    turns = np.array(
        [se3.log_so3(a[:3, :3].T @ b[:3, :3]) for a, b in itertools.combinations(T, 2)]
    )
    return np.sqrt(np.linalg.eigvalsh(np.einsum("ni,nj->ij", turns, turns) / len(turns)))


@pytest.mark.parametrize("count", [3, 20])
def test_every_wanted_view_holds_the_whole_board(count: int) -> None:
    board, views, camera = Board(), Views(), ZED2.camera
    stacks = list(views.wanted(board, camera, count, stream(4, "test")))
    assert count <= len(stacks) <= 5 * count
    T = np.concatenate(stacks)
    to_camera = board.sheet()[:, :2].mean(axis=0) - T[:, :2, 3], -T[:, 2, 3]
    distance = np.hypot(np.linalg.norm(to_camera[0], axis=1), to_camera[1])
    assert distance.min() > 0.349 and distance.max() < 0.601
    tilt = np.arccos(-T[:, 2, 3] / distance)
    assert tilt.min() > views.tilt[0] - 1e-9 and tilt.max() < views.tilt[1] + 1e-9
    T_camera_board = se3.inverse(T)
    sheet = np.einsum("nij,kj->nki", T_camera_board[:, :3, :3], board.sheet())
    pixels = camera.project(sheet + T_camera_board[:, None, :3, 3])
    assert pixels.min() >= 0.04 * 720 - 1
    assert (pixels <= 0.96 * np.array([1280, 720])).all()
    assert spread(np.array([stack[0] for stack in stacks[:count]])).min() > 0.2


def test_a_board_of_ones_own_is_known_by_its_text_and_site() -> None:
    board = replace(Board(), columns=7, rows=4, square_m=0.05)
    spec = mujoco.MjSpec()
    add_print(spec, board, T_WORLD_BOARD)
    model = World(spec.to_xml(), dict(spec.assets)).model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    poses = np.eye(4)[None]
    track = Track(np.zeros(1), poses, poses)
    found = calibration.of_model(model, data, track)
    assert found is not None and set(found) == {"board", "T_base_board_true"}
    assert Board.from_json(found["board"]) == board
    np.testing.assert_allclose(found["T_base_board_true"], T_WORLD_BOARD, atol=1e-5)
    print_ = model.geom("print").id
    normal = data.geom_xmat[print_].reshape(3, 3) @ np.linalg.svd(model.mesh_vert)[2][2]
    assert abs(normal @ T_WORLD_BOARD[:3, 2]) > 1.0 - 1e-6

    with pytest.raises(SimulationError, match="no arm"):
        BoardArm().track(model, 0)
    with pytest.raises(OptionError, match="expected one that fits"):
        next(Views().wanted(replace(board, square_m=0.2), ZED2.camera, 3, stream(0, "test")))


def test_models_without_a_board_say_so() -> None:
    poses = np.eye(4)[None]
    track = Track(np.zeros(1), poses, poses)
    texts = ("", '<text name="board" data="round"/>', f"<text name=\"board\" data='{_JSON}'/>")
    bare, wrong, homeless = (
        mujoco.MjModel.from_xml_string(f"<mujoco><custom>{text}</custom></mujoco>")
        for text in texts
    )
    assert calibration.of_model(bare, mujoco.MjData(bare), track) is None
    with pytest.raises(SimulationError, match="no calibration board"):
        BoardArm().track(bare, 0)
    for model, text in ((wrong, "expected the JSON of a board"), (homeless, "expected a site")):
        with pytest.raises(SimulationError, match=text):
            calibration.of_model(model, mujoco.MjData(model), track)


_JSON = '{"kind": "checkerboard", "columns": 9, "rows": 6, "square_m": 0.02}'
