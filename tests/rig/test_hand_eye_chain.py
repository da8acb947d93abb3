"""The derivatives of the chain, the beliefs, and the verdict on the motions."""

from __future__ import annotations

import numpy as np
import pytest

from depthba import se3
from depthba.kinematics import UR16E
from depthba.optimiser.prior import move
from rig.hand_eye.depth.believed import Beliefs, estimate, posterior
from rig.hand_eye.depth.chain import Chain, without_gauge
from rig.hand_eye.depth.verdict import open_directions
from rig.hand_eye.flanges import motion_fault, turned
from tests.rig.arm_scene import X, flanges

N = 4


def chain(seed: int = 0) -> Chain:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.5, 1.5, (N, 6))
    return Chain(
        T_map_base=se3.make(se3.exp_so3([0.3, -0.2, 1.0]), [0.5, 0.2, -0.1]),
        T_base_flange=UR16E.forward(q),
        T_flange_camera=X,
        missed=np.zeros((N, 6)),
        joints=UR16E.jacobian(q).reshape(6 * N, 6),
        zeros=np.zeros(6),
    )


def test_jacobian_equals_finite_differences() -> None:
    one = chain()
    pivots = np.random.default_rng(1).uniform(-1, 1, (N, 3))
    J = one.jacobian(pivots)
    h = 1e-6
    for k in range(J.shape[1]):
        step = h * np.eye(J.shape[1])[k]
        moved = one.moved(step).T_map_camera
        predicted = move(one.T_map_camera, pivots, (J @ step).reshape(N, 6))
        assert np.abs(se3.difference(moved, predicted)).max() < 1e-4 * h


def test_zeros_move_the_flange_as_the_arm_does() -> None:
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.5, 1.5, (N, 6))
    one, off = chain(), 1e-5 * rng.standard_normal(6)
    step = np.concatenate([np.zeros(6), off, np.zeros(6 * N)])
    difference = se3.difference(one.moved(step).T_base_flange_corrected, UR16E.forward(q + off))
    assert np.abs(difference).max() < 1e-8


def test_what_moves_all_cameras_alike_is_taken_off_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    pivots, motion = rng.uniform(-1, 1, (N, 3)), rng.standard_normal(6)
    alike = np.hstack([motion[:3] + np.cross(motion[3:], pivots), np.tile(motion[3:], (N, 1))])
    other = rng.standard_normal((6 * N, 2))
    assert np.abs(without_gauge(alike.reshape(-1, 1), pivots)).max() < 1e-12
    once = without_gauge(other, pivots)
    np.testing.assert_allclose(without_gauge(once + alike.reshape(-1, 1), pivots), once, atol=1e-12)
    assert np.linalg.matrix_rank(np.hstack([other - once, alike.reshape(-1, 1)])) <= 3


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
    stated = Beliefs(np.full(6, 0.01), 1e-4, 5e-5, 1e-4, 0.0)
    beliefs, step, _ = estimate(H, g, np.zeros(len(g)), stated, 0, frames, 0)
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
