"""Boards: what is drawn is found again where it is, and the right way round."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from depthba import se3
from depthba.boards import Board
from depthba.camera import Camera
from depthba.errors import OptionError

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
BOARDS = {"checkerboard": Board(), "charuco": Board.charuco()}
NEAR = 8


def seen(board: Board, T_camera_board: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The board's print as a camera sees it, each pixel the mean over its square."""
    side = 16
    low = board.sheet()[0, :2]
    # From pixels of the print to the board's plane, pixel centres at integers.
    scale = board.square_m / side
    to_board = np.array(
        [[scale, 0, low[0] + 0.5 * scale], [0, scale, low[1] + 0.5 * scale], [0, 0, 1]]
    )
    fine = np.array([[NEAR, 0, 0.5 * (NEAR - 1)], [0, NEAR, 0.5 * (NEAR - 1)], [0, 0, 1]])
    H = fine @ CAMERA.matrix @ T_camera_board[:3, [0, 1, 3]] @ to_board
    size = (NEAR * CAMERA.width, NEAR * CAMERA.height)
    drawn = cv2.warpPerspective(board.image(side), H, size, flags=cv2.INTER_NEAREST, borderValue=90)
    small = cv2.resize(drawn, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    return np.asarray(40 + 0.7 * small, np.uint8)


def project(board: Board, T_camera_board: NDArray[np.float64]) -> NDArray[np.float64]:
    return CAMERA.project(board.corners() @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])


def facing(board: Board, turn: list[float], distance: float) -> NDArray[np.float64]:
    """T_camera_board: turned by a rotation vector about the board's middle, in the image's."""
    R = se3.exp_so3(turn)
    return se3.make(R, [0.0, 0.0, distance] - R @ board.corners().mean(axis=0))


@pytest.mark.parametrize("kind", BOARDS)
@pytest.mark.parametrize(
    "turn", [[0.0, 0.0, 0.1], [0.5, -0.2, 2.9], [-0.3, 0.6, -1.4], [0.6, 0.1, 0.8]]
)
def test_corners_are_found_where_they_are(kind: str, turn: list[float]) -> None:
    board = BOARDS[kind]
    T_camera_board = facing(board, turn, 0.62)
    image = seen(board, T_camera_board)
    for picture in (image, np.repeat(image[..., None], 3, axis=2)):
        ids, pixels = board.detect(picture)
        np.testing.assert_array_equal(ids, np.arange(70))
        error = pixels - project(board, T_camera_board)
        assert np.sqrt(np.square(error).sum(axis=1).mean()) < 0.05
        assert np.abs(error.mean(axis=0)).max() < 0.02


def test_what_is_hidden_of_a_charuco_board_is_left_out() -> None:
    board = BOARDS["charuco"]
    T_camera_board = facing(board, [0.2, 0.1, 0.3], 0.6)
    image, truth = seen(board, T_camera_board), project(board, T_camera_board)
    image[:, : int(truth[:, 0].mean())] = 128
    ids, pixels = board.detect(image)
    assert 20 <= len(ids) < 40
    assert np.linalg.norm(pixels - truth[ids], axis=1).max() < 0.15
    ids, pixels = BOARDS["checkerboard"].detect(image)
    assert ids.shape == (0,) and pixels.shape == (0, 2)
    assert board.detect(np.full_like(image, 128))[0].shape == (0,)


@pytest.mark.parametrize("kind", BOARDS)
def test_the_print_begins_with_a_black_square_and_has_its_corners_on_the_sheet(kind: str) -> None:
    board, side = BOARDS[kind], 20
    image, sheet = board.image(side, margin=1.0), board.sheet(margin=1.0)
    np.testing.assert_allclose(np.ptp(sheet, axis=0)[:2] / board.square_m * side, image.shape[::-1])
    # Board coordinates to rows and columns between the pixels.
    u, v = np.rint((board.corners()[:, :2] - sheet[0, :2]) / board.square_m * side).astype(int).T
    for row, column in ((v - 1, u - 1), (v, u)):
        first = image[row, column].reshape(7, 10)
        assert len(set(first[::2, ::2].ravel())) == 1 and first[0, 0] != first[0, 1]
    assert image[v[0] - 1, u[0] - 1] == 0 and image[v[0] - 1, u[0]] == 255
    assert image[:side].min() == 255 and image[:, -side:].min() == 255


def test_the_frame_is_opencvs_but_for_its_origin() -> None:
    board = BOARDS["charuco"]
    theirs = cv2.aruco.CharucoBoard(
        (11, 8), 0.03, 0.0225, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    )
    np.testing.assert_allclose(
        board.corners(), theirs.getChessboardCorners() - [0.03, 0.03, 0.0], atol=1e-8
    )


@pytest.mark.parametrize("kind", BOARDS)
def test_json_round_trip(kind: str) -> None:
    board = replace(BOARDS[kind], square_m=0.025)
    assert Board.from_json(json.loads(json.dumps(board.json()))) == board


WRONG: dict[str, tuple[Any, str]] = {
    "no object": (3, "board is 3"),
    "no kind": ({"columns": 9, "rows": 6}, "'kind' is missing"),
    "kind": (Board().json() | {"kind": "circles"}, "board.kind is \"circles\", expected"),
    "columns": (Board().json() | {"columns": 1}, "board.columns is 1"),
    "square": (Board().json() | {"square_m": -1}, "board.square_m is -1"),
    "marker": (Board.charuco().json() | {"marker_m": 0.05}, "marker_m 0.05: expected"),
    "dictionary": (Board.charuco().json() | {"dictionary": "DICT_9"}, "DICT_9.*DICT_4X4_50"),
    "no dictionary": (Board.charuco().json() | {"dictionary": None}, "needs its dictionary"),
    "too few markers": (Board.charuco().json() | {"columns": 14}, "50 markers, expected 60"),
    "a marker": (Board().json() | {"marker_m": 0.01}, "of a checkerboard"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_no_board_is_named(case: str) -> None:
    value, text = WRONG[case]
    with pytest.raises(OptionError, match=text):
        Board.from_json(value)
