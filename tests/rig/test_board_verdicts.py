"""Data that cannot give X: each says what is wrong, and none gives a confident wrong number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from depthba import se3
from depthba.boards import Board
from depthba.errors import DatasetError, OptionError
from rig.hand_eye.board.calibration import BoardHandEye, BoardOptions, Intrinsics, calibrate
from rig.hand_eye.board.observations import Mount, Observations
from rig.hand_eye.board.suspects import numbering, symmetries
from tests.rig.board_problems import POINTS, Setup, X, error, observed, problem, views

Floats = NDArray[np.float64]
Change = Callable[[Observations], Observations]

PLAIN = Setup(count=12)


def grid(pixels: Floats) -> Floats:
    return pixels.reshape(len(pixels), 7, 10, 2)


def flanges(change: Callable[[Floats], Floats]) -> Change:
    return lambda o: replace(o, T_base_flange=change(o.T_base_flange))


def turned(turn: Callable[[Floats], Floats]) -> Callable[[Floats], Floats]:
    return lambda T: se3.make(se3.exp_so3(turn(se3.log_so3(T[:, :3, :3]))), T[:, :3, 3])


def quaternions(shift: int) -> Callable[[Floats], Floats]:
    return lambda T: se3.from_quaternion(T[:, :3, 3], np.roll(se3.quaternion(T), shift, axis=1))


def longer(factor: float) -> Callable[[Floats], Floats]:
    return lambda T: se3.make(T[:, :3, :3], factor * T[:, :3, 3])


def mirrored_order(o: Observations) -> Observations:
    pixels = grid(o.pixels).copy()
    pixels[::3] = pixels[::3, :, ::-1]
    return replace(o, pixels=pixels.reshape(o.pixels.shape))


def half_turned_order(o: Observations) -> Observations:
    pixels = grid(o.pixels).copy()
    pixels[1:3] = pixels[1:3, ::-1, ::-1]
    return replace(o, pixels=pixels.reshape(o.pixels.shape))


def mirrored_images(o: Observations) -> Observations:
    flipped = grid(o.pixels)[:, :, ::-1].copy()
    flipped[..., 0] = 2 * o.camera.cx - flipped[..., 0]
    return replace(o, pixels=flipped.reshape(o.pixels.shape))


WRONG: dict[str, tuple[Change, str]] = {
    "inverted flange poses": (flanges(se3.inverse), "T_flange_base where T_base_flange"),
    "transposed rotations": (
        flanges(lambda T: se3.make(np.swapaxes(T[:, :3, :3], 1, 2), T[:, :3, 3])),
        "rotations are transposed",
    ),
    "quaternions w first": (flanges(quaternions(1)), "quaternions were read w x y z"),
    "quaternions w last": (flanges(quaternions(-1)), "quaternions were read x y z w"),
    "radians read as degrees": (flanges(turned(np.radians)), "in radians, read as degrees"),
    "degrees read as radians": (flanges(turned(np.degrees)), "rotations in radians"),
    "another frame's poses": (flanges(lambda T: np.roll(T, 1, axis=0)), "do not belong together"),
    "flange in millimetres": (flanges(longer(1e3)), "flange positions are not in metres"),
    "board in millimetres": (
        lambda o: replace(o, points=1e3 * o.points),
        "squares are stated too large (in millimetres?)",
    ),
    "squares of another size": (lambda o: replace(o, points=1.27 * o.points), "times as large"),
    "squares a little off": (lambda o: replace(o, points=1.01 * o.points), "squares are 29.6"),
    "corners mirrored in some": (mirrored_order, "0, 3, 6, 9 are numbered mirrored"),
    "half a turn in some": (half_turned_order, "1, 2 are numbered from the other end"),
    "mirrored images": (mirrored_images, "the images are mirrored"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_does_not_belong_together_is_named_and_gives_no_number(case: str) -> None:
    change, text = WRONG[case]
    result = calibrate(change(problem(PLAIN, 0)))
    assert result.status == "inconsistent" and not result.trusted
    assert text in result.reason, result.reason
    assert result.T is None and result.covariance is None


def test_the_wrong_mount_is_named_both_ways() -> None:
    in_hand = problem(PLAIN, 1)
    fixed = problem(replace(PLAIN, mount="eye-to-hand"), 1)
    cases: list[tuple[Observations, Mount, str]] = [
        (in_hand, "eye-to-hand", "--mount eye-in-hand"),
        (fixed, "eye-in-hand", "--mount eye-to-hand"),
    ]
    for o, mount, other in cases:
        result = calibrate(o, BoardOptions(mount=mount))
        assert result.status == "inconsistent" and other in result.reason


def within_its_sigmas(result: BoardHandEye) -> bool:
    assert result.T is not None and result.covariance is not None
    delta = se3.difference(result.T, X)
    scale = np.sqrt(np.diag(result.covariance))
    both = result.covariance / np.outer(scale, scale)
    return float(delta / scale @ np.linalg.solve(both, delta / scale)) < 40


def test_without_turns_the_place_is_open_and_says_so() -> None:
    rng = np.random.default_rng(0)
    P = views(PLAIN, rng)
    P[:, :3, :3] = P[0, :3, :3]
    P[:, :3, 3] = rng.uniform([-0.2, -0.15, 0.4], [0.05, 0.0, 0.65], (len(P), 3))
    result = calibrate(observed(PLAIN, P, rng))
    assert result.status == "weak" and "never turned" in result.reason
    assert result.T is not None and result.covariance is not None
    assert len(result.open) == 3
    assert np.sqrt(np.diag(result.covariance)[:3]).min() > 0.1
    assert error(result.T)[0] < 0.2
    assert within_its_sigmas(result)


def test_turns_about_one_axis_leave_the_place_along_it_open() -> None:
    rng = np.random.default_rng(1)
    P = views(PLAIN, rng)
    turn = se3.exp_so3(rng.uniform(-1, 1, (len(P), 1)) * [0.0, 0.0, 1.0])
    P[:, :3, :3] = turn @ se3.exp_so3([0.3, 0.1, 0.0])
    P[:, :3, 3] = rng.uniform([-0.05, -0.05, 0.4], [0.05, 0.05, 0.65], (len(P), 3))
    P[:, :3, 3] -= P[:, :3, :3] @ POINTS.mean(axis=0)
    result = calibrate(observed(PLAIN, P, rng))
    assert result.status == "weak" and "parallel axis" in result.reason
    assert [o.name for o in result.open] == ["z"]
    assert result.T is not None and result.covariance is not None
    assert np.linalg.norm(result.T[:2, 3] - X[:2, 3]) < 0.05
    assert np.sqrt(result.covariance[2, 2]) > 0.1
    assert within_its_sigmas(result)


def test_turns_of_a_degree_or_two_are_too_few() -> None:
    result = calibrate(problem(replace(PLAIN, tilt=2, turn=2), 0))
    assert result.status == "weak" and "turned by only" in result.reason


@pytest.mark.parametrize(("intrinsics", "off"), [("fixed", (0.001, 1.5)), ("prior", (0.01, 10.0))])
def test_another_camera_than_was_stated(intrinsics: Intrinsics, off: tuple[float, float]) -> None:
    options = BoardOptions(intrinsics=intrinsics)
    assert calibrate(problem(Setup(), 3), options).trusted
    wrong = calibrate(problem(Setup(camera_off=off), 3), options)
    assert wrong.status == "inconsistent" and wrong.T is None
    assert "of another camera than stated" in wrong.reason


def test_two_poses_are_refused() -> None:
    o = problem(PLAIN, 0)
    with pytest.raises(DatasetError, match=r"2 poses .* expected 3 or more"):
        calibrate(o.subset([0, 1]))
    blind = o.pixels.copy()
    blind[2:] = np.nan
    with pytest.raises(DatasetError, match="found in 2 frames"):
        calibrate(replace(o, pixels=blind))
    with pytest.raises(OptionError, match="--robot-sigma"):
        BoardOptions(robot_sigma=(0.0, 1.0))
    with pytest.raises(OptionError, match=r"expected \(12, 70, 2\)"):
        replace(o, pixels=o.pixels[:, :5])


def test_an_order_that_is_mirrored_in_all_images_changes_the_boards_frame_alone() -> None:
    o = problem(PLAIN, 0)
    one = calibrate(o)
    mirrored = grid(o.pixels)[:, :, ::-1].reshape(o.pixels.shape)
    other = calibrate(replace(o, pixels=mirrored))
    assert one.trusted and other.trusted and one.T is not None and other.T is not None
    np.testing.assert_allclose(other.T, one.T, atol=1e-7)


def test_a_board_that_looks_alike_after_half_a_turn_is_numbered_by_the_robot() -> None:
    o = problem(PLAIN, 0)
    reference = calibrate(o)
    result = calibrate(half_turned_order(o), alike=True)
    assert result.trusted and result.T is not None and reference.T is not None
    np.testing.assert_allclose(result.T, reference.T, atol=1e-7)
    S = symmetries(POINTS)
    for label in range(4):
        np.testing.assert_allclose(S[label] @ S[label], np.eye(4), atol=1e-12)
    rng = np.random.default_rng(0)
    P = views(PLAIN, rng)
    labels = np.zeros(len(P), np.int64)
    labels[[4, 6]] = [2, 1]
    G = X @ P @ se3.make(se3.exp_so3([0.1, 0.2, 0.3]), [0.1, 0.2, 0.3])
    found = numbering(G, np.einsum("nij,njk->nik", P, S[labels]), POINTS)
    np.testing.assert_array_equal(found.labels, labels)
    np.testing.assert_allclose(found.P, P, atol=1e-12)


def test_boards_are_read_from_words() -> None:
    assert Board.parse("10x7x0.03") == Board()
    assert Board.parse("charuco:10x7x0.03") == Board.charuco()
    five = Board.parse("charuco:8x5x0.04:DICT_5X5_100:0.03")
    assert (five.dictionary, five.marker_m) == ("DICT_5X5_100", 0.03)
    for words in ("10x7", "10x7x0.03x2", "round:10x7x0.03", "axbxc", "10x7x0.03:DICT_4X4_50", ""):
        with pytest.raises(OptionError, match="expected"):
            Board.parse(words)
