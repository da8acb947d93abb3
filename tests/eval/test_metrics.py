"""Errors of poses: what was put in must come out, in any world frame."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from depthba import se3
from eval.metrics import Metric, consistency, pose_metrics, split, start

Floats = NDArray[np.float64]


def trajectory(n: int, seed: int = 0) -> Floats:
    rng = np.random.default_rng(seed)
    return se3.make(Rotation.random(n, random_state=seed).as_matrix(), rng.normal(size=(n, 3)))


def values(metrics: list[Metric]) -> dict[str, float]:
    return {m.name: m.value for m in metrics}


def test_errors_that_were_put_in_come_out() -> None:
    T_true = trajectory(8)
    delta = np.random.default_rng(3).normal(size=(8, 6)) * ([1e-3] * 3 + [1e-2] * 3)
    delta[0] = 0.0
    got = values(pose_metrics(se3.retract(T_true, delta), T_true))
    e = delta[1:]
    for name, part in (("translation", e[:, :3]), ("rotation", e[:, 3:])):
        assert_allclose(got[f"{name}_mae"], np.abs(part).mean(), rtol=1e-9)
        assert_allclose(got[f"{name}_rmse"], np.sqrt((part**2).mean()), rtol=1e-9)
        assert_allclose(got[f"{name}_max"], np.abs(part).max(), rtol=1e-9)
        assert_allclose(got[f"{name}_mae_y"], np.abs(part[:, 1]).mean(), rtol=1e-9)
        assert_allclose(got[f"{name}_rmse_z"], np.sqrt((part[:, 2] ** 2).mean()), rtol=1e-9)


def test_the_world_frame_of_the_estimate_does_not_matter() -> None:
    T_true = trajectory(6)
    T_est = se3.retract(T_true, np.random.default_rng(4).normal(size=(6, 6)) * 1e-3)
    moved = trajectory(1, seed=9)[0] @ T_est
    here, there = values(pose_metrics(T_est, T_true)), values(pose_metrics(moved, T_true))
    for name, value in here.items():
        assert_allclose(there[name], value, rtol=1e-6, atol=1e-12, err_msg=name)


def test_trajectory_and_relative_errors_by_their_definitions() -> None:
    T_true, T_est = trajectory(9, 1), trajectory(9, 1)
    T_est = se3.retract(T_est, np.random.default_rng(5).normal(size=(9, 6)) * 0.02)
    got = values(pose_metrics(T_est, T_true))

    p, q = T_est[:, :3, 3], T_true[:, :3, 3]
    R, rssd = Rotation.align_vectors(q - q.mean(0), p - p.mean(0))[:2]
    assert_allclose(got["ate_rmse"], rssd / np.sqrt(9), rtol=1e-7)
    assert_allclose(R.as_matrix() @ R.as_matrix().T, np.eye(3), atol=1e-12)

    moved, turned = [], []
    for i in range(8):
        step_true = np.linalg.inv(T_true[i]) @ T_true[i + 1]
        E = np.linalg.inv(step_true) @ np.linalg.inv(T_est[i]) @ T_est[i + 1]
        moved.append(np.linalg.norm(E[:3, 3]))
        turned.append(Rotation.from_matrix(E[:3, :3]).magnitude())
    assert_allclose(got["rpe_translation_rmse"], np.sqrt(np.mean(np.square(moved))), rtol=1e-9)
    assert_allclose(got["rpe_rotation_rmse"], np.sqrt(np.mean(np.square(turned))), rtol=1e-9)


def test_an_honest_covariance_scores_one_and_a_bold_one_more() -> None:
    """Errors drawn from a joint covariance, frame 0 uncertain too, in another world frame."""
    n, draws = 5, 60
    rng = np.random.default_rng(6)
    T_true = trajectory(n, 2)
    T_world_other = trajectory(1, 3)[0]
    root = rng.normal(size=(6 * n, 6 * n)) * 1e-5
    covariance = root @ root.T
    honest, bold = [], []
    for _ in range(draws):
        delta = (root @ rng.normal(size=6 * n)).reshape(n, 6)
        T_est = se3.retract(T_world_other @ T_true, delta)
        found = consistency(T_est, T_true, covariance)
        assert found.dof == 6 * n - 6
        honest.append(found.nees_per_dof)
        bold.append(consistency(T_est, T_true, covariance / 9.0).nees_per_dof)
    spread = np.sqrt(2.0 / (draws * (6 * n - 6)))
    assert abs(np.mean(honest) - 1.0) < 4.0 * spread
    assert_allclose(np.mean(bold), 9.0 * np.mean(honest), rtol=1e-6)


def test_directions_without_variance_are_no_degrees_of_freedom() -> None:
    T_true = trajectory(4, 7)
    variances = np.full(24, 1e-6)
    variances[:6] = 0.0  # anchored
    variances[12:18] = 0.0  # held
    found = consistency(T_true, T_true, np.diag(variances))
    assert found.dof == 12
    assert_allclose(found.nees_per_dof, 0.0, atol=1e-12)


def test_start_metrics_carry_their_prefix_and_lose_it_again() -> None:
    metrics = [Metric("ate_rmse", "m", "lower", 0.5)]
    both = [*metrics, *start(metrics)]
    assert [m.name for m in both] == ["ate_rmse", "start_ate_rmse"]
    assert split(both) == (metrics, metrics)
