from __future__ import annotations

import numpy as np
import pytest

from depthba import se3
from depthba.kinematics import UR16E, DhArm

LIMITS = np.array(UR16E.lower), np.array(UR16E.upper)


def joints(count: int, seed: int = 0, share: float = 0.5) -> np.ndarray:
    low, high = LIMITS
    return share * np.random.default_rng(seed).uniform(low, high, (count, 6))


@pytest.fixture(scope="module")
def calibrated() -> DhArm:
    """An arm as the maker measures it: every parameter a little off."""
    rng = np.random.default_rng(1)
    delta = rng.normal(scale=[[3e-4], [3e-4], [1e-3], [1e-3]], size=(4, 6))
    return UR16E.calibrated(*delta)


def test_the_arm_stretched_out_is_as_long_as_its_links() -> None:
    a, d = UR16E.a, UR16E.d
    T = UR16E.forward(np.zeros(6))
    np.testing.assert_allclose(T[:3, 3], [a[1] + a[2], -d[3] - d[5], d[0] - d[4]], atol=1e-15)
    # The flange looks the way the shoulder's lift axis points.
    np.testing.assert_allclose(T[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)


def test_forward_kinematics_agree_with_an_analytic_solver() -> None:
    solver = pytest.importorskip("ur_analytic_ik").ur16e
    q = joints(300)
    expected = np.stack([solver.forward_kinematics(*one) for one in q])
    np.testing.assert_allclose(UR16E.forward(q), expected, atol=1e-12)
    # And each of its solutions is found again from nearby.
    found = np.stack(solver.inverse_kinematics(expected[0]))
    again, right = UR16E.solve(expected[0], found + 0.1)
    assert len(found) > 1 and right.all()
    np.testing.assert_allclose(again, found, atol=1e-9)


def test_jacobian_is_the_derivative(calibrated: DhArm) -> None:
    step = 1e-6
    for arm in (UR16E, calibrated):
        q = joints(20, seed=2)
        for i in range(6):
            e = step * np.eye(6)[i]
            slope = se3.difference(arm.forward(q + e), arm.forward(q - e)) / (2.0 * step)
            np.testing.assert_allclose(arm.jacobian(q)[..., i], slope, atol=1e-9)


def test_frames_lead_from_base_to_flange(calibrated: DhArm) -> None:
    q = joints(12, seed=3).reshape(3, 4, 6)
    frames = calibrated.frames(q)
    assert frames.shape == (3, 4, 7, 4, 4)
    assert se3.is_rigid(frames, 1e-12)
    np.testing.assert_array_equal(frames[..., 0, :, :], np.broadcast_to(np.eye(4), (3, 4, 4, 4)))
    np.testing.assert_array_equal(frames[..., -1, :, :], calibrated.forward(q))
    # The links' lengths hold at any angle.
    length = np.linalg.norm(np.diff(frames[..., :3, 3], axis=-2), axis=-1)
    expected = np.hypot(calibrated.a, calibrated.d)
    np.testing.assert_allclose(length, np.broadcast_to(expected, length.shape), atol=1e-14)


def test_a_correction_of_theta_is_a_joint_offset() -> None:
    offset = np.array([1e-3, -2e-3, 5e-4, 0.0, 1e-3, -1e-3])
    q = joints(10, seed=4)
    moved = UR16E.calibrated(theta=offset).forward(q)
    np.testing.assert_allclose(moved, UR16E.forward(q + offset), atol=1e-15)


def test_inverse_undoes_forward(calibrated: DhArm) -> None:
    rng = np.random.default_rng(5)
    for arm in (UR16E, calibrated):
        q = joints(2000, seed=6, share=0.45)
        T = arm.forward(q)
        found, right = arm.solve(T, q + rng.normal(scale=0.2, size=q.shape))
        clear = arm.manipulability(q) > 0.02
        assert right[clear].mean() > 0.999
        assert np.abs(se3.difference(arm.forward(found), T))[right].max() <= 1e-12
        assert arm.within_limits(found)[right].all()
    one = UR16E.inverse(T[0], q[0])
    assert one is not None and one.shape == (6,)


def test_no_joints_for_a_pose_out_of_reach() -> None:
    T = UR16E.forward(joints(1)[0])
    T[:3, 3] = [1.5, 0.0, 0.5]
    assert UR16E.inverse(T, np.zeros(6)) is None


def test_limits_are_kept_by_full_turns_or_not_at_all() -> None:
    q = np.array([0.3, -1.4, 1.5, -1.7, -1.5, 0.2])
    T = UR16E.forward(q)
    # From a start beyond the limit: the same pose by full turns back.
    wound = UR16E.inverse(T, q + 4.0 * np.pi * np.eye(6)[5])
    assert wound is not None and UR16E.within_limits(wound)
    turns = (wound - q) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    # Where a turn does not help, the nearby solution is none.
    stop = DhArm(**{**vars(UR16E), "lower": (0.5, *UR16E.lower[1:]), "upper": (1.0,) * 6})
    assert not stop.within_limits(q) and stop.inverse(T, q) is None


def test_a_stretched_arm_is_singular() -> None:
    bent = np.array([0.3, -1.4, 1.5, -1.7, -1.5, 0.2])
    straight, flat_wrist = bent.copy(), bent.copy()
    straight[2] = flat_wrist[4] = 0.0
    assert UR16E.manipulability(bent) > 0.1
    assert UR16E.manipulability(np.stack([straight, flat_wrist])).max() < 1e-12


def test_parameters_must_belong_to_one_arm() -> None:
    with pytest.raises(ValueError, match=r"d \(0.1,\): expected one for each of the 6 joints"):
        DhArm(**{**vars(UR16E), "d": (0.1,)})
    with pytest.raises(ValueError, match=r"alpha .*expected finite"):
        UR16E.calibrated(alpha=np.nan)
    with pytest.raises(ValueError, match=r"joints of shape \(5,\): expected"):
        UR16E.forward(np.zeros(5))
