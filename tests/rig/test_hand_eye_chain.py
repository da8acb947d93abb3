"""The derivatives of the chain, the beliefs, and the verdict on the motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from depthba import se3
from depthba.kinematics import UR16E
from rig.hand_eye.depth.believed import Beliefs, estimate, posterior
from rig.hand_eye.depth.chain import Chain
from rig.hand_eye.depth.fit import Seen, Start, fit, put_first, relative
from rig.hand_eye.depth.verdict import open_directions
from rig.hand_eye.flanges import motion_fault, turned
from tests.rig.arm_scene import X, flanges

N = 4


def chain(seed: int = 0) -> Chain:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.5, 1.5, (N, 6))
    return Chain(
        T_world_base=se3.make(se3.exp_so3([0.3, -0.2, 1.0]), [0.5, 0.2, -0.1]),
        T_base_flange=UR16E.forward(q),
        T_flange_camera=X,
        missed=np.zeros((N, 6)),
        joints=UR16E.jacobian(q).reshape(6 * N, 6),
        zeros=np.zeros(6),
    )


def test_jacobian_equals_finite_differences() -> None:
    one = chain()
    J = one.jacobian()
    h = 1e-6
    for k in range(J.shape[1]):
        step = h * np.eye(J.shape[1])[k]
        moved = one.moved(step).T_world_camera
        predicted = se3.retract(one.T_world_camera, (J @ step).reshape(N, 6))
        assert np.abs(se3.difference(moved, predicted)).max() < 1e-4 * h


def test_zeros_move_the_flange_as_the_arm_does() -> None:
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.5, 1.5, (N, 6))
    one, off = chain(), 1e-5 * rng.standard_normal(6)
    step = np.concatenate([np.zeros(6), off, np.zeros(6 * N)])
    difference = se3.difference(one.moved(step).T_base_flange_corrected, UR16E.forward(q + off))
    assert np.abs(difference).max() < 1e-8


def seen_from(one: Chain, rng: np.random.Generator, sigma: float) -> Seen:
    """Poses as a registration has them, relative to the first, which lies elsewhere."""
    root = rng.standard_normal((6 * N - 6, 6 * N - 6))
    covariance = sigma**2 * (root @ root.T / (6 * N) + 0.1 * np.eye(6 * N - 6))
    off = np.concatenate([np.zeros(6), rng.multivariate_normal(np.zeros(6 * N - 6), covariance)])
    T = se3.retract(one.T_world_camera, off.reshape(N, 6))
    world = se3.make(se3.exp_so3([0.1, 0.4, -0.3]), [1.0, 2.0, -3.0])
    turn = np.kron(np.eye(2 * N - 2), world[:3, :3])
    return Seen(world @ T, np.arange(1, N), np.linalg.inv(turn @ covariance @ turn.T))


def test_what_is_off_relative_to_the_first_against_finite_differences() -> None:
    rng = np.random.default_rng(4)
    seen = seen_from(chain(), rng, 1e-3)
    one = put_first(chain(), seen.T_world_camera[0])
    e, J = relative(one, seen)
    h = 1e-6
    for k in range(J.shape[1]):
        moved = put_first(one.moved(h * np.eye(J.shape[1])[k]), seen.T_world_camera[0])
        found = (relative(moved, seen)[0] - e) / h
        np.testing.assert_allclose(found, J[:, k], atol=2e-3)


def test_the_fit_finds_x_and_its_covariance_covers_the_error() -> None:
    squares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        true = chain()
        missed = rng.standard_normal((N, 6)) * np.repeat([5e-5, 1e-4], 3)
        seen = seen_from(replace(true, missed=missed), rng, 1e-4)
        start = Start(se3.retract(X, 1e-2 * rng.standard_normal(6)), np.full(6, 1e-2))
        begun = replace(true, T_flange_camera=start.T_flange_camera)
        found = fit(begun, seen, start, Beliefs(start.sigma, 5e-4, 5e-5, 1e-4))
        assert found.converged
        error = se3.difference(found.chain.T_flange_camera, X)
        squares.append(error @ np.linalg.solve(found.covariance[:6, :6], error) / 6)
        assert np.abs(error).max() < 2e-3
    assert 0.2 < np.mean(squares) < 1.6


def test_frames_of_which_nothing_is_known_leave_x_at_its_start() -> None:
    true = chain()
    nothing = Seen(true.T_world_camera, np.arange(0), np.zeros((0, 0)))
    start = Start(X, np.full(6, 1e-2))
    found = fit(true, nothing, start, Beliefs(start.sigma, 5e-4, 5e-5, 1e-4))
    np.testing.assert_allclose(found.chain.T_flange_camera, X, atol=1e-12)
    np.testing.assert_allclose(np.diag(found.covariance)[:6], start.sigma**2)


def test_posterior_weighs_data_and_beliefs() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((5, 5))
    H, truth = root @ root.T, rng.standard_normal(5)
    variance = np.array([1e-6, 1.0, 1e6, 4.0, 0.25])
    step, covariance = posterior(H, -H @ truth, np.zeros(5), variance)
    inverse = H + np.diag(1 / variance)
    np.testing.assert_allclose(covariance @ inverse, np.eye(5), atol=1e-8)
    np.testing.assert_allclose(step, np.linalg.solve(inverse, H @ truth), atol=1e-9)


def test_a_robot_worse_than_stated_is_found_out() -> None:
    rng = np.random.default_rng(0)
    frames = 40
    missed = rng.standard_normal((frames, 6)) * np.repeat([1e-3, 2e-3], 3)
    H = np.diag(np.concatenate([np.ones(6), np.full(6 * frames, 1e12)]))
    g = -H @ np.concatenate([np.zeros(6), missed.ravel()])
    stated = Beliefs(np.full(6, 0.01), 1e-4, 5e-5, 1e-4)
    beliefs, step, _ = estimate(H, g, np.zeros(len(g)), stated, 0, frames)
    assert beliefs.robot_t == pytest.approx(1e-3, rel=0.15)
    assert beliefs.robot_r == pytest.approx(2e-3, rel=0.15)
    np.testing.assert_allclose(step[6:], missed.ravel(), atol=1e-5)


def test_motions_name_what_they_leave_open() -> None:
    assert motion_fault(flanges(8, "xyz")) == ""
    assert motion_fault(flanges(8, "xy")) == ""
    assert "never turned" in motion_fault(flanges(8, ""))
    fault = motion_fault(flanges(8, "z"))
    assert "parallel axis (0.00, 0.00, 1.00)" in fault
    size, axes = turned(flanges(8, "z"))
    assert size[0] > 0.3 and size[1] < 1e-6
    assert abs(axes[2, 0]) == pytest.approx(1.0)


def test_open_directions_are_named_in_the_units_of_the_start() -> None:
    sigma = np.array([0.01, 0.01, 0.01, 0.02, 0.02, 0.02])
    covariance = np.diag((sigma * [0.01, 0.01, 0.9, 0.01, 0.01, 0.01]) ** 2)
    (found,) = open_directions(covariance, sigma)
    assert found.name == "z"
    assert found.share == pytest.approx(0.81)
