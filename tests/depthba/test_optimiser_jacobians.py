"""Jacobians against finite differences, on surfaces where the nodal gradient is exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from depthba import se3
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import Linearisation, Loss, State, Workers, linearise
from depthba.optimiser.prior import PosePrior, about_pivot, move, pose_prior
from tests.depthba import numpy_reference as reference
from tests.depthba.optimiser_problems import (
    RANGE,
    VERTICAL,
    Floats,
    looking_down,
    problem_of,
    view,
)

GRID = Grid(np.array([-0.6, -0.6]), 0.05, (25, 25))


@dataclass(frozen=True)
class Quadratic:
    """A surface whose central differences are exact, and linear between the nodes."""

    xx: float
    xy: float
    yy: float

    def __call__(self, x: Floats, y: Floats) -> Floats:
        return 0.1 * x - 0.2 * y + self.xx * x * x + self.xy * x * y + self.yy * y * y

    def heights(self) -> Floats:
        x, y = (GRID.origin[k] + GRID.spacing * np.arange(25) for k in (0, 1))
        return np.asarray(self(*np.meshgrid(x, y)))


BOWL = Quadratic(0.5, -0.3, 0.4)
# without squares the bilinear interpolant is the surface itself: a foot on one lies on the other
SADDLE = Quadratic(0.0, 0.6, 0.0)


def lone_points(
    surface: Quadratic, loss: Loss, off: float, count: int = 12
) -> tuple[Floats, Floats, Linearisation]:
    """Linearise frames of one point each, ``off`` metres from the surface along the ray.

    A frame's blocks are then one row's. The pivots lie some way from the points.
    """
    rng = np.random.default_rng(5)
    T = looking_down(count, rng)
    points = np.concatenate([view(pose, surface, 1, rng) for pose in T])
    points *= 1 + off / np.linalg.norm(points, axis=1, keepdims=True)
    points = points.astype(np.float32).astype(float)
    clouds = [np.array([[*p, 1.0, 1.0]]) for p in points]
    problem = problem_of(clouds, T)
    pivots = [f.centroid + rng.uniform(-0.2, 0.2, 3) for f in problem.frames]
    frames = [replace(f, centroid=c) for f, c in zip(problem.frames, pivots, strict=True)]
    lin = linearise(
        replace(problem, frames=tuple(frames)),
        GRID,
        State(T, surface.heights()),
        replace(loss, smoothing=0.0),
        Workers(1),
        np.zeros(GRID.shape, bool),
    )
    assert lin.used == count
    return points, T, lin


def derivative(value: Callable[[Floats], Floats], step: float, size: int = 6) -> Floats:
    """Central differences of value(x) at 0, one column per component."""
    return np.stack([(value(e) - value(-e)) / (2 * step) for e in step * np.eye(size)], axis=-1)


def test_vertical_pose_columns() -> None:
    points, T, lin = lone_points(BOWL, VERTICAL, 0.01)

    def residual(delta: Floats) -> Floats:
        moved = move(T, lin.pivots, np.tile(delta, (len(T), 1)))
        q = np.einsum("nij,nj->ni", moved[:, :3, :3], points) + moved[:, :3, 3]
        return q[:, 2] - BOWL(q[:, 0], q[:, 1])

    numeric = derivative(residual, 1e-6)
    # A = J J^T of the one point, and J_z = 1
    np.testing.assert_allclose(lin.A[:, 2], numeric, atol=1e-8)
    np.testing.assert_allclose(lin.A, np.einsum("ni,nj->nij", numeric, numeric), atol=1e-8)
    np.testing.assert_allclose(lin.g_pose[:, 2], residual(np.zeros(6)), atol=0.5 * GRID.spacing**2)


def walk(points: Floats, T: Floats, surface: Quadratic) -> Floats:
    """Signed distance from each point back along its ray to the surface, to convergence."""
    q = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
    u = (q - T[:, :3, 3]) / np.linalg.norm(q - T[:, :3, 3], axis=1, keepdims=True)
    s = np.zeros(len(q))
    for _ in range(30):
        f = q - s[:, None] * u
        n = np.stack(
            [-(0.1 + surface.xy * f[:, 1]), 0.2 - surface.xy * f[:, 0], np.ones(len(f))], axis=1
        )
        s += (f[:, 2] - surface(f[:, 0], f[:, 1])) / (n * u).sum(axis=1)
    return s


def test_range_pose_columns() -> None:
    points, T, lin = lone_points(SADDLE, RANGE, 0.005)

    def distance(delta: Floats) -> Floats:
        return walk(points, move(T, lin.pivots, np.tile(delta, (len(T), 1))), SADDLE)

    numeric = derivative(distance, 1e-6)
    assert np.abs(distance(np.zeros(6))) == pytest.approx(0.005, rel=1e-3)
    # the row is that of r = distance (n . u): one factor per point, which J_z = 1 tells
    J = lin.A[:, 2] / lin.A[:, 2, 2:3]
    np.testing.assert_allclose(J, numeric / numeric[:, 2:3], atol=1e-6)
    n_dot_u = 1 / numeric[:, 2]
    r = lin.g_pose[:, 2] / lin.A[:, 2, 2]
    np.testing.assert_allclose(r, distance(np.zeros(6)) * n_dot_u, atol=1e-9)
    # r^2 w is the squared distance, less what lateral noise takes: 1 + 0.05 |n|^2 / (n.u)^2
    share = n_dot_u**2 / (n_dot_u**2 + 0.05 * (J[:, :3] ** 2).sum(axis=1))
    np.testing.assert_allclose(r * lin.g_pose[:, 2], share * distance(np.zeros(6)) ** 2, rtol=1e-6)


@pytest.mark.parametrize("ranged", [False, True])
def test_height_columns(ranged: bool) -> None:
    points, T, lin = lone_points(SADDLE, RANGE if ranged else VERTICAL, 0.0)
    heights = SADDLE.heights()

    def found(i: int, D: Floats) -> reference.Residual:
        D_map, pivot = reference.Map(D, GRID.origin, GRID.spacing), np.zeros(3)
        if ranged:
            residual = reference.ranged(points[i], T[i], pivot, D_map, -1.0, 0.1)
        else:
            residual = reference.vertical(points[i], T[i], pivot, D_map)
        assert residual is not None
        return residual

    for i, foot in enumerate(lin.B):
        row = np.zeros(GRID.shape)
        row[foot.window] = foot.values[..., 2] / lin.A[i, 2, 2]
        assert np.count_nonzero(row) == 4
        n_dot_u = found(i, heights).n_dot_u
        for node in [*np.argwhere(row), (12, 12)]:
            step = np.zeros(GRID.shape)
            step[tuple(node)] = 1e-7
            up, down = found(i, heights + step), found(i, heights - step)
            # the row of the range residual is that of distance (n . u)
            change = n_dot_u * (up.walked - down.walked) if ranged else up.r - down.r
            assert row[tuple(node)] == pytest.approx(change / 2e-7, abs=2e-6)


def some_prior(isotropic: bool, on_arm: bool = False) -> tuple[Floats, Floats, PosePrior]:
    rng = np.random.default_rng(2)
    measured = looking_down(5, rng)
    sigma_t = np.full(3, 0.01) if isotropic else np.array([0.01, 0.002, 0.05])
    sigma_r = np.full(3, 0.02) if isotropic else np.array([0.004, 0.02, 0.1])
    R_map_world = se3.exp_so3([0.3, -0.5, 0.2])
    return measured, rng.uniform(-1, 1, (5, 3)), pose_prior(
        measured, R_map_world, sigma_t, sigma_r, np.arange(5) == 0,
        (np.array([0.02, 0.03, 0.04]), np.array([0.03, 0.02, 0.01])) if on_arm else None,
    )  # fmt: skip


@pytest.mark.parametrize("on_arm", [False, True])
@pytest.mark.parametrize("isotropic", [True, False])
def test_prior_normal_equations(isotropic: bool, on_arm: bool) -> None:
    measured, pivots, prior = some_prior(isotropic, on_arm)
    rng = np.random.default_rng(3)
    T = se3.retract(measured, rng.normal(scale=0.003, size=(5, 6)))
    matrix, gradient = prior.at(T).normal_equations(pivots)

    def cost(delta: Floats) -> Floats:
        poses = np.repeat(T[None], 5, axis=0)
        for i in range(5):
            poses[i, i] = move(T[i : i + 1], pivots[i : i + 1], delta[None])[0]
        return np.array([prior.at(p).cost for p in poses])

    numeric = derivative(cost, 1e-6) / 2
    # the logarithm's derivative is taken as the identity, which isotropic rotations about one place
    # do not notice
    exact = isotropic and not on_arm
    scale = np.abs(gradient).max()
    np.testing.assert_allclose(gradient, numeric, atol=(1e-6 if exact else 5e-3) * scale)
    assert not gradient[0].any() and not matrix[:6].any()


def test_prior_knows_what_the_frames_share() -> None:
    """At the measured poses its inverse is the covariance of the poses relative to frame 0.

    Each frame's own, and frame 0's carried to it: a shift, and a turn about frame 0.
    """
    measured, _, prior = some_prior(False)
    assert prior.gauge is not None
    carried = about_pivot(measured, measured[:1, :3, 3])[1:].reshape(-1, 6)
    want = block_diag(*np.linalg.inv(prior.information[1:]))
    want = want + carried @ np.linalg.inv(prior.gauge) @ carried.T
    about_centres = prior.at(measured).normal_equations(measured[:, :3, 3])[0][6:, 6:]
    np.testing.assert_allclose(
        np.linalg.inv(about_centres), want, rtol=1e-6, atol=1e-9 * np.abs(want).max()
    )


def test_prior_knows_that_the_frames_share_a_hand_eye_transform() -> None:
    """Its inverse holds that transform's covariance, seen from frame 0, in every frame."""
    measured, _, prior = some_prior(False, on_arm=True)
    assert prior.gauge is not None and prior.hand_eye is not None
    carried = about_pivot(measured, measured[:1, :3, 3])[1:]
    turned = np.stack([np.kron(np.eye(2), T[:3, :3]) for T in measured])
    want = block_diag(*np.linalg.inv(prior.information[1:]))
    shared = (turned[1:] - carried @ turned[0]).reshape(-1, 6)
    carried = carried.reshape(-1, 6)
    want = want + carried @ np.linalg.inv(prior.gauge) @ carried.T
    want = want + shared @ np.linalg.inv(prior.hand_eye) @ shared.T
    about_centres = prior.at(measured).normal_equations(measured[:, :3, 3])[0][6:, 6:]
    np.testing.assert_allclose(
        np.linalg.inv(about_centres), want, rtol=1e-6, atol=1e-9 * np.abs(want).max()
    )


def test_a_wrong_hand_eye_transform_costs_once_and_not_by_frame() -> None:
    measured, _, prior = some_prior(True, on_arm=True)
    # an arm is ten times better than that
    assert prior.gauge is not None
    prior = replace(prior, information=100 * prior.information, gauge=100 * prior.gauge)
    wrong = se3.make(se3.exp_so3([0.02, -0.01, 0.015]), [0.01, 0.02, -0.02])
    poses = measured @ wrong
    poses = measured[0] @ np.linalg.inv(poses[0]) @ poses
    assert prior.at(poses).cost < 4.0
    assert replace(prior, hand_eye=None).at(poses).cost > 20.0


def test_prior_lets_frame_0_pay_for_what_all_frames_share() -> None:
    measured, _, prior = some_prior(True)
    slip = np.array([[0.004, -0.003, 0.002, 0.01, 0.02, -0.015]])
    turned = move(measured, np.repeat(measured[:1, :3, 3], 5, axis=0), np.repeat(slip, 5, axis=0))
    turned[0] = measured[0]
    assert prior.gauge is not None
    alone = float(slip[0] @ prior.gauge @ slip[0])
    assert 0.5 * alone < prior.at(turned).cost <= alone * (1 + 1e-9)
    assert replace(prior, gauge=None).at(turned).cost > 3 * alone


def test_prior_is_in_world_axes() -> None:
    measured, _, prior = some_prior(False)
    R_map_world = se3.exp_so3([0.3, -0.5, 0.2])
    for k, sigma in enumerate([0.01, 0.002, 0.05, 0.004, 0.02, 0.1]):
        delta = np.zeros((5, 6))
        delta[:, 3 * (k // 3) : 3 * (k // 3) + 3] = 3 * sigma * R_map_world[:, k % 3]
        # frame 0 has none
        alone = replace(prior, gauge=None)
        assert alone.at(se3.retract(measured, delta)).cost == pytest.approx(4 * 9, rel=1e-6)


def test_move_is_about_the_pivot() -> None:
    rng = np.random.default_rng(4)
    T, pivots, delta = looking_down(3, rng), rng.normal(size=(3, 3)), rng.normal(size=(3, 6))
    p = rng.normal(size=(3, 3))
    q = np.einsum("nij,nj->ni", T[:, :3, :3], p) + T[:, :3, 3]
    moved = move(T, pivots, delta)
    want = np.einsum("nij,nj->ni", se3.exp_so3(delta[:, 3:]), q - pivots) + pivots + delta[:, :3]
    got = np.einsum("nij,nj->ni", moved[:, :3, :3], p) + moved[:, :3, 3]
    np.testing.assert_allclose(got, want, atol=1e-12)
