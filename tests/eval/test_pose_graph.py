"""Pose graphs on made-up measurements, and generalised ICP with its derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from depthba import se3
from eval.methods.gicp import GicpOptions, align, prepare
from eval.methods.graph import Edge, isotropic, solve, solve_robustly, spanning_tree
from eval.methods.method import MethodError, Stopwatch, relative
from eval.methods.pairs import PairOptions, feature_pairs
from eval.methods.pose_graph import GicpPgo, TeaserPgo, TeaserPgoGnc, usual_reach
from eval.methods.voxel import usual_voxel
from eval.metrics import pose_metrics
from tests.eval.reference_scenes import made_task, reference_task

pytest.importorskip("gtsam")

Floats = NDArray[np.float64]

ALIKE = isotropic(0.01, 0.01)


def ring(count: int = 8, seed: int = 0) -> Floats:
    """Poses on a circle that look all ways."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(count) / count
    centres = np.stack([np.cos(angle), np.sin(angle), 0.3 * rng.normal(size=count)], axis=1)
    return se3.make(se3.exp_so3(rng.normal(size=(count, 3))), centres)


def edge(T: Floats, i: int, j: int, information: Floats = ALIKE) -> Edge:
    return Edge(i, j, relative(T, i, j), information)


def loop(T: Floats, reach: int = 1) -> list[Edge]:
    """Every frame with its next ones, round to the first."""
    n = len(T)
    return [edge(T, i, (i + k) % n) for k in range(1, reach + 1) for i in range(n)]


def drifted(T: Floats, size: float = 0.05, seed: int = 1) -> Floats:
    off = np.random.default_rng(seed).normal(size=(len(T), 6)) * size
    off[0] = 0.0
    return se3.retract(T, off)


def test_a_closed_loop_gives_back_the_poses() -> None:
    T = ring()
    found = solve(drifted(T), loop(T))
    assert_allclose(found.T_world_camera, T, atol=1e-7)
    assert found.error < 1e-9 and found.loose == ()
    assert found.iterations is not None and found.iterations > 0


def test_a_gap_is_shared_by_the_whole_loop() -> None:
    """Where rotations are sure, each of twelve edges takes a twelfth of what does not close."""
    T = ring(12)
    edges = [replace(e, information=isotropic(0.01, 1e-6)) for e in loop(T)]
    edges[5] = replace(edges[5], T_i_j=se3.retract(edges[5].T_i_j, [2e-3, 0, 0, 0, 0, 0]))
    found = solve(T, edges)
    assert_allclose(found.error, 0.5 * (2e-3 / 0.01) ** 2 / 12, rtol=1e-3)
    gone = np.linalg.norm(found.T_world_camera[6, :3, 3] - T[6, :3, 3])
    assert_allclose(gone, 2e-3 / 2, rtol=1e-2)  # six twelfths of it, half way round


def test_the_wrong_order_of_poses_shows() -> None:
    """T_j_i in place of T_i_j is no consistent loop, and no way back to the poses."""
    T = ring()
    turned = [replace(e, T_i_j=se3.inverse(e.T_i_j)) for e in loop(T, reach=2)]
    found = solve(T, turned)
    assert found.error > 1e3
    swapped = [Edge(e.j, e.i, se3.inverse(e.T_i_j), e.information) for e in loop(T, reach=2)]
    assert_allclose(solve(drifted(T), swapped).T_world_camera, T, atol=1e-7)


@pytest.mark.parametrize("axis", range(6))
def test_information_is_translation_first_in_the_axes_of_frame_j(axis: int) -> None:
    """Of two measurements that differ along one axis, the one that is sure of it wins."""
    T = ring(2)
    delta = np.eye(6)[axis] * 1e-3
    Exp = se3.retract(np.eye(4), delta)  # one axis alone: the same as the exponential
    sure = ALIKE.copy()
    sure[axis, axis] = 99 * ALIKE[axis, axis]
    edges = [edge(T, 0, 1), Edge(0, 1, relative(T, 0, 1) @ Exp, sure)]
    found = solve(T, edges).T_world_camera
    assert_allclose(se3.inverse(T[1]) @ found[1], se3.retract(np.eye(4), 0.99 * delta), atol=1e-8)


def test_an_outlier_is_rejected_and_one_loss_for_all_is_not_robust() -> None:
    T = ring()
    edges = loop(T, reach=2)
    wrong = se3.retract(edges[3].T_i_j, [0.5, -0.3, 0.2, 0.4, 0.2, -0.5])
    edges[3] = replace(edges[3], T_i_j=wrong)
    plain = solve(T, edges)
    assert np.abs(plain.T_world_camera - T).max() > 0.01
    support = [1.0] * len(edges)
    start, _ = spanning_tree(T, edges, support)
    robust = solve_robustly(start, edges)
    assert_allclose(robust.T_world_camera, T, atol=1e-6)
    assert robust.weights[3] < 1e-3
    assert np.delete(robust.weights, 3).min() > 0.99


def test_the_tree_takes_what_has_most_support() -> None:
    T = ring()
    edges = [*loop(T), replace(edge(T, 0, 4), T_i_j=np.eye(4))]
    support = [10.0] * 8 + [1.0]
    found, used = spanning_tree(drifted(T), edges, support)
    assert_allclose(found, T, atol=1e-12)
    assert len(used) == 7 and 8 not in used
    support[-1] = 100.0
    found, used = spanning_tree(drifted(T), edges, support)
    assert_allclose(found[4], T[0], atol=1e-12)
    assert 8 in used


@pytest.mark.parametrize("method", [solve, solve_robustly])
def test_what_is_not_connected_keeps_its_start(method) -> None:
    T = ring()
    start = drifted(T)
    edges = [edge(T, 0, 1), edge(T, 2, 1), edge(T, 5, 6)]
    found = method(start, edges)
    assert found.loose == (3, 4, 5, 6, 7)
    assert_allclose(found.T_world_camera[:3], T[:3], atol=1e-6)
    assert_allclose(found.T_world_camera[3:], start[3:])
    assert found.weights.tolist() == [1.0, 1.0, 0.0]
    tree, _ = spanning_tree(start, edges, [1.0] * 3)
    assert_allclose(tree[3:], start[3:])
    with pytest.raises(ValueError, match="edge 1 - 8"):
        method(start, [edge(T, 0, 1), Edge(1, 8, np.eye(4), ALIKE)])


def waves(count: int, seed: int) -> Floats:
    """Points at random on a surface 1 m before the sensor, that has shape in all directions."""
    xy = np.random.default_rng(seed).uniform(-0.3, 0.3, (count, 2))
    x, y = xy.T
    z = 1.0 + 0.05 * np.sin(9 * x) * np.cos(11 * y) + 0.03 * np.sin(17 * y + 5 * x)
    return np.column_stack([xy, z])


def test_generalised_icp_finds_a_motion_and_tells_its_curvature() -> None:
    """H is checked through what it is used for: the cost that a graph thinks a step has."""
    import small_gicp

    options = GicpOptions(rotation_epsilon=1e-7, translation_epsilon=1e-8)
    T_target_source = se3.retract(np.eye(4), [0.05, -0.02, 0.03, 1.2, -0.03, 0.3])
    points = waves(20000, 0)
    moved = points @ T_target_source[:3, :3] - T_target_source[:3, 3] @ T_target_source[:3, :3]
    target, source = (prepare(p, 0.01, options) for p in (points, moved))
    near = se3.retract(T_target_source, [2e-3, 1e-3, -2e-3, 3e-3, -2e-3, 2e-3])
    found = align(target, source, near, 0.03, options)
    assert found.converged and found.inliers > 1000
    assert np.abs(se3.difference(found.T_target_source, T_target_source)).max() < 3e-4

    def cost(delta: Floats) -> float:
        T = found.T_target_source @ se3.retract(np.eye(4), delta)
        factor, rejector = small_gicp.GICPFactor(), small_gicp.DistanceRejector()
        rejector.set_max_distance(0.03)
        total = 0.0
        for k in range(0, len(source), 3):
            ok, *_, e = factor.linearize(target.cloud, source.cloud, target.tree, T, k, rejector)
            total += e if ok else 0.0
        return 3 * total

    here = cost(np.zeros(6))
    for axis, step in enumerate([3e-3] * 3 + [6e-3] * 3):
        delta = np.eye(6)[axis] * step
        rise = 0.5 * (cost(delta) + cost(-delta)) - here
        # partners change with the step, which makes the true cost rise less than the quadratic
        assert 0.3 < rise / (0.5 * delta @ found.H @ delta) < 1.5


def test_a_frame_without_points_has_no_alignment() -> None:
    options = GicpOptions()
    empty, full = (prepare(p, 0.01, options) for p in (np.empty((0, 3)), waves(500, 0)))
    found = align(full, empty, np.eye(4), 0.1, options)
    assert not found.converged and found.inliers == 0


def test_defaults_follow_spacing_noise_and_the_start() -> None:
    task, _, _ = reference_task("s0")
    assert_allclose(usual_voxel(task), 4 * task.spacing)
    assert 0.04 < usual_reach(task) < 0.06


@pytest.mark.parametrize(
    ("name", "translation", "rotation"),
    [("s0", 0.127e-3, 0.27e-3), pytest.param("s1", 1.7e-3, 3.1e-3, marks=pytest.mark.slow)],
)
def test_reference_scenes(name: str, translation: float, rotation: float) -> None:
    task, T_true, _ = reference_task(name, 0.01, 0.02)
    found = GicpPgo().run(task)
    errors = {m.name: m.value for m in pose_metrics(found.T_world_camera, T_true)}
    assert errors["translation_mae"] < 1.5 * translation
    assert errors["rotation_mae"] < 1.5 * rotation
    assert_allclose(found.T_world_camera[0], T_true[0], atol=1e-12)
    assert found.notes == () and set(found.seconds) == {"pairs", "points", "gicp", "graph"}


def test_frames_apart_are_said_to_be_so() -> None:
    T = np.tile(np.eye(4), (3, 1, 1))
    T[2, 0, 3] = 5.0
    clouds = (waves(20000, 0), waves(20000, 1), waves(20000, 2))
    task = made_task(T, clouds, spacing=4e-3)
    found = GicpPgo(voxel=0.01, reach=0.03).run(task)
    assert found.notes == ("not connected to frame 0, kept at their start poses: 2",)
    assert_allclose(found.T_world_camera[2], T[2])
    T[1, 0, 3] = -5.0
    with pytest.raises(MethodError, match="no two frames overlap"):
        GicpPgo().run(made_task(T, clouds, spacing=4e-3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "voxel", "translation", "rotation"),
    [("s0", 0.008, 1.1e-3, 1.6e-3), ("s1", 0.010, 13e-3, 29e-3)],
)
def test_teaser_pairs_on_the_reference_scenes(
    name: str, voxel: float, translation: float, rotation: float
) -> None:
    """On s1 the figures are those of the robust graph: the reference's other one is lost."""
    task, T_true, _ = reference_task(name, 0.01, 0.02)
    options = PairOptions(voxel=voxel)
    for method in (TeaserPgo(pairs=options), TeaserPgoGnc(pairs=options)):
        found = method.run(task)
        errors = {m.name: m.value for m in pose_metrics(found.T_world_camera, T_true)}
        assert errors["translation_mae"] < 1.5 * translation
        assert errors["rotation_mae"] < 1.5 * rotation


@pytest.mark.slow
def test_the_references_own_pairs_give_its_figures() -> None:
    """Which weak pairs take part decides: from a start that is off, others overlap by a quarter."""
    task, T_true, overlap = reference_task("s0")
    wanted = [(i, j) for i in range(12) for j in range(i + 1, 12) if overlap[i, j] > 0.25]
    assert len(wanted) == 27
    _, found, _ = feature_pairs(task, wanted, PairOptions(voxel=0.008), Stopwatch())
    edges = [Edge(p.target, p.source, p.T_target_source, ALIKE) for p in found]
    start, _ = spanning_tree(task.T_world_camera, edges, [len(p.inliers) for p in found])
    solved = solve(start, edges).T_world_camera
    errors = {m.name: m.value for m in pose_metrics(solved, T_true)}
    assert errors["translation_mae"] < 1.2 * 1.05e-3
    assert errors["rotation_mae"] < 1.2 * 1.54e-3
