"""The parts of calibration with a board: derivatives, closed forms, refinement, noises."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import Camera
from rig.hand_eye.board import chain as ch
from rig.hand_eye.board import opencv, park_martin
from rig.hand_eye.board.calibration import BoardHandEye, BoardOptions, Intrinsics, calibrate
from rig.hand_eye.board.detection import velocities
from rig.hand_eye.board.observations import Mount, Observations
from rig.hand_eye.board.pnp import board_poses
from tests.rig.board_problems import (
    CAMERA,
    COLUMNS,
    DEGREE,
    POINTS,
    Setup,
    X,
    Y,
    error,
    observed,
    problem,
    views,
)

Floats = NDArray[np.float64]
CAMERAS: tuple[Intrinsics, ...] = ("fixed", "prior")
ORACLE = Path(__file__).parents[3] / "shared" / "oracles" / "handeye.npz"


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_all_derivatives_equal_finite_differences(mount: Mount) -> None:
    rng = np.random.default_rng(0)
    given = problem(Setup(count=4, mount=mount), 0)
    lens = (0.1, -0.05, 0.001, 0.002, 0.01)
    observations = replace(
        given,
        camera=Camera(1280, 720, 528, 530, 640, 360, lens),
        joints=rng.standard_normal((4, 6, 6)),
    )
    velocity = rng.standard_normal((4, 6))
    off = np.array([0.01, 0.002, 1.0, 2.0, 0.01, 0.01, 0.001, 0.001, 0.01])
    at = ch.Chain(
        X, Y, 0.01 * rng.standard_normal((4, 6)), off, 0.003, 0.002, 1e-3 * rng.standard_normal(6)
    )
    error, J, J_pose = ch.linearise(at, observations, velocity)
    np.testing.assert_allclose(error, ch.errors(at, observations, velocity), atol=1e-9)
    h, none, still = 1e-6, np.zeros(at.shared), np.zeros((4, 6))

    def slope(step: Floats, missed: Floats) -> Floats:
        there, back = (
            ch.errors(at.moved(s * step, s * missed), observations, velocity) for s in (h, -h)
        )
        return np.asarray((there - back) / (2 * h))

    for k in range(at.shared):
        expected = slope(np.eye(at.shared)[k], still)
        assert np.abs(J[..., k] - expected).max() < 1e-6 * max(1.0, np.abs(expected).max()), k
    for k in range(6):
        expected = slope(none, np.tile(np.eye(6)[k], (4, 1)))
        assert np.abs(J_pose[..., k] - expected).max() < 1e-6 * np.abs(expected).max(), k


def test_exact_motions_give_exact_answers() -> None:
    exact = Setup(count=6, corner=0.0, robot_t=0.0, robot_r=0.0)
    for mount in ("eye-in-hand", "eye-to-hand"):
        o = problem(replace(exact, mount=mount), 3)
        P = board_poses(o).T_camera_board
        m = park_martin.motions(o.carrier, P)
        for found in (park_martin.park_martin(m), park_martin.solve(m)):
            np.testing.assert_allclose(found, X, atol=1e-8)
        scaled = m.B.copy()
        scaled[:, :3, 3] *= 0.5
        assert park_martin.solve_translation(m.A, scaled, X[:3, :3], scale=True)[1] == (
            pytest.approx(2.0, abs=1e-9)
        )


def test_stored_problems_park_martin_as_opencv_and_the_refinement_ahead_of_all() -> None:
    if not ORACLE.exists():
        pytest.skip(f"{ORACLE} is not here")
    stored = np.load(ORACLE)
    K = stored["K"]
    camera = Camera(1280, 720, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    for k in range(int(stored["n_problems"])):
        o = Observations(
            stored[f"T_base_flange_{k}"], stored["board_points"], stored[f"pixels_{k}"], camera
        )
        P = stored[f"T_camera_board_pnp_{k}"]
        np.testing.assert_allclose(board_poses(o).T_camera_board, P, atol=1e-7)
        ours = park_martin.park_martin(park_martin.motions(o.carrier, P))
        off = se3.difference(ours, stored[f"X_PARK_{k}"])
        assert np.linalg.norm(off[3:]) < 1e-6 * DEGREE
        assert np.linalg.norm(off[:3]) < 1e-9
        for intrinsics in CAMERAS:
            result = calibrate(o, BoardOptions(intrinsics=intrinsics))
            assert result.status == "converged" and result.T is not None
            degrees, mm = error(result.T, stored[f"X_true_{k}"])
            for method in opencv.METHODS:
                stood = stored[f"X_{method}_{k}"]
                np.testing.assert_allclose(opencv.solve(o.carrier, P, method), stood, atol=1e-6)
                other = error(stood, stored[f"X_true_{k}"])
                assert degrees < other[0] and mm < other[1], (k, method)


@pytest.mark.parametrize("column", COLUMNS)
def test_a_few_trials_of_the_study(column: str) -> None:
    """The whole of it is tests/benchmarks/test_hand_eye.py."""
    ours, others, chi2 = [], [], []
    for seed in range(4):
        o = problem(COLUMNS[column], seed)
        result = calibrate(o, BoardOptions(intrinsics="prior" if column == "K off" else "fixed"))
        assert result.trusted and result.T is not None and result.covariance is not None
        ours.append(error(result.T))
        others.append([error(result.methods[f"opencv {m.lower()}"]) for m in opencv.METHODS])
        delta = se3.difference(result.T, X)
        chi2.append(float(delta @ np.linalg.solve(result.covariance, delta)))
    assert (np.median(ours, axis=0) < np.median(others, axis=0)).all()
    # 24 degrees of freedom: between the 0.1 and 99.9 % quantiles
    assert 8 < sum(chi2) < 52


def test_intrinsics_from_the_images_alone() -> None:
    far_off = Setup(camera_off=(0.05, 20.0))
    result = calibrate(problem(far_off, 1), BoardOptions(intrinsics="estimated"))
    assert result.T is not None and result.covariance is not None
    delta = se3.difference(result.T, X)
    assert delta @ np.linalg.solve(result.covariance, delta) < 20
    assert error(result.T)[1] < 1.0
    assert result.estimate is not None
    found = result.estimate.solution.chain.camera(result.observations)
    assert found.fx == pytest.approx(CAMERA.fx, abs=1.5)


def test_bad_poses_and_bad_corners_are_found_and_left_out() -> None:
    clean = problem(Setup(), 1)
    rng = np.random.default_rng(5)
    bad = [2, 7, 11, 15]
    T, pixels = clean.T_base_flange.copy(), clean.pixels.copy()
    T[bad] = se3.retract(T[bad], rng.choice([-1, 1], (4, 6)) * np.repeat([0.003, 0.01], 3))
    T[bad[0], 0, 3] += 0.2
    pixels[3, 5] += [10.0, 4.0]
    pixels[9] += 30.0 * rng.standard_normal(pixels[9].shape)
    pixels[4, :9] = np.nan
    result = calibrate(replace(clean, T_base_flange=T, pixels=pixels))
    assert result.trusted and result.T is not None and result.estimate is not None
    assert list(np.flatnonzero(result.estimate.dropped)) == bad
    assert any("flange poses do not fit the rest: frames 2, 7, 11, 15" in n for n in result.notes)
    assert any("corners do not fit the rest: frames 9" in note for note in result.notes)
    weights = result.estimate.solution.problem.corner_weights
    assert weights[3, 5] == 0 and weights[4, :9].sum() == 0 and weights[4, 9:].min() == 1
    # as good as the others alone would have it
    assert result.covariance is not None
    delta = se3.difference(result.T, X)
    assert delta @ np.linalg.solve(result.covariance, delta) < 22
    others = calibrate(clean.subset([k for k in range(20) if k not in (*bad, 9)]))
    assert others.T is not None
    degrees, mm = error(result.T, others.T)
    assert degrees < 0.03 and mm < 0.15
    noise = result.estimate.solution.problem.noise
    assert noise.corner == pytest.approx(0.3, rel=0.05)
    assert noise.robot_t == pytest.approx(5e-5, rel=0.5)


def test_a_robot_ten_times_worse_is_found_out_unless_stated() -> None:
    o = problem(COLUMNS["robot x 10"], 2)
    free = calibrate(o)
    assert free.estimate is not None
    noise = free.estimate.solution.problem.noise
    assert noise.robot_t == pytest.approx(5e-4, rel=0.3)
    assert noise.robot_r == pytest.approx(0.1 * DEGREE, rel=0.5)
    held = calibrate(o, BoardOptions(robot_sigma=(5e-4, 0.1)))
    assert held.estimate is not None and held.estimate.solution.problem.noise.robot_t == 5e-4


def test_the_next_pose_does_what_was_promised() -> None:
    setup = Setup(count=6)
    rng = np.random.default_rng(8)
    P = views(setup, rng)
    options = BoardOptions(robot_sigma=(5e-5, 0.01))
    first = calibrate(observed(setup, P, rng), options)
    assert first.next is not None and first.next.after < 0.9 * first.next.before
    second = calibrate(
        observed(setup, np.concatenate([P, first.next.T_camera_board[None]]), rng), options
    )
    assert second.next is not None
    assert second.next.before == pytest.approx(first.next.after, rel=0.15)
    pixels = CAMERA.project(
        POINTS @ first.next.T_camera_board[:3, :3].T + first.next.T_camera_board[:3, 3]
    )
    assert (pixels > 0).all() and (pixels < [1280, 720]).all()


def moving(late: float, seed: int) -> Observations:
    """A flange that never stops, its stamps late by so many seconds."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(25) * 0.1
    phase = rng.uniform(0, 2 * np.pi, 6)
    rate = rng.uniform(1.0, 1.8, 6)
    size = [0.08, 0.08, 0.06, 0.3, 0.3, 0.5]
    middle = se3.make(np.eye(3), [0.0, 0.0, 0.5])

    def camera(t: Floats) -> Floats:
        swing = size * np.sin(rate * t[:, None] + phase)
        # about the board's middle
        board = se3.make(se3.exp_so3(swing[:, 3:]), swing[:, :3]) @ se3.make(
            np.eye(3), -POINTS.mean(axis=0)
        )
        return np.asarray(middle @ board)

    setup = Setup()
    seen = observed(setup, camera(stamps - late), rng)
    told = observed(setup, camera(stamps), rng)
    T = told.T_base_flange
    return replace(
        seen, T_base_flange=T, stamps=stamps, velocity=velocities(T, stamps),
    )  # fmt: skip


def test_a_clock_that_is_off_is_found_and_put_right() -> None:
    result = calibrate(moving(0.02, 0))
    assert result.clock is not None and result.clock_free
    assert result.clock.value == pytest.approx(-0.02, abs=0.001)
    assert result.trusted and result.T is not None
    assert any("ms off" in note for note in result.notes)
    in_step = calibrate(moving(0.0, 0))
    assert in_step.clock is not None and not in_step.clock_free
    assert abs(in_step.clock.value) < 0.001
    standing = calibrate(problem(Setup(), 0))
    assert standing.clock is None


def test_stops_say_nothing_about_speed() -> None:
    T = se3.make(np.eye(3), np.linspace([0, 0, 0], [1, 0, 0], 5))
    assert not velocities(T, 3.0 * np.arange(5.0)).any()
    np.testing.assert_allclose(velocities(T, 0.1 * np.arange(5.0))[1:4, 0], 2.5)


def result_of(o: Observations, **options: Any) -> BoardHandEye:
    return calibrate(o, BoardOptions(**options))


def test_equal_inputs_give_equal_bits_and_arguments_stay_as_they_are() -> None:
    o = problem(Setup(count=8), 0)
    T, pixels = o.T_base_flange.copy(), o.pixels.copy()
    one, other = result_of(o), result_of(o)
    assert one.T is not None and other.T is not None
    np.testing.assert_array_equal(one.T, other.T)
    np.testing.assert_array_equal(o.T_base_flange, T)
    np.testing.assert_array_equal(o.pixels, pixels)
