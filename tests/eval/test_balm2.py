"""BALM2 against the reference's numbers, finite differences, and known planes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from depthba import se3
from depthba.clouds import thin, transform
from depthba.errors import OptionError
from eval.methods.balm2 import schedule as schedules
from eval.methods.balm2.clusters import cluster_points, covariances, join_clusters, move_clusters
from eval.methods.balm2.cost import cost, linearise, retract
from eval.methods.balm2.schedule import Schedule
from eval.methods.balm2.solver import SolverOptions, displacement, solve
from eval.methods.balm2.voxels import Planes, VoxelOptions, find_planes
from eval.methods.method import MethodError, Stopwatch

Floats = NDArray[np.float64]
ORACLES = Path(__file__).parents[3] / "shared" / "oracles"


def oracle(name: str) -> Any:
    if not (ORACLES / name).exists():
        pytest.skip(f"{name}: no reference figures beside the checkout")
    return np.load(ORACLES / name, allow_pickle=False)


# -- the reference's own numbers -------------------------------------------------------------------


@pytest.fixture(scope="module")
def small() -> Iterator[Any]:
    with oracle("balm2_small.npz") as file:
        yield dict(file)


def clouds_of(small: Any) -> list[NDArray[np.float32]]:
    return np.split(small["points"], small["offsets"][1:-1])


@pytest.mark.parametrize("case", [0, 1])
def test_agrees_with_the_reference(small: Any, case: int) -> None:
    T = small["poses_init"]
    options = VoxelOptions(float(small["voxel_sizes"][case]))
    planes = find_planes(clouds_of(small), T, options)
    assert len(planes) == small[f"n_planes_{case}"]
    np.testing.assert_array_equal(planes.per_frame, small[f"planes_per_pose_{case}"])
    np.testing.assert_array_equal(
        np.bincount(planes.layer), np.bincount(small[f"feature_table_{case}"][:, 7].astype(int))
    )
    for poses, J, H in (
        (T, small[f"J_{case}"], small[f"H_{case}"]),
        (small[f"poses_opt_{case}"], small[f"J_opt_{case}"], small[f"H_opt_{case}"]),
    ):
        found = linearise(planes, poses)
        np.testing.assert_allclose(found.J, J, rtol=0, atol=1e-7 * np.abs(small[f"J_{case}"]).max())
        np.testing.assert_allclose(found.H, H, rtol=0, atol=1e-6 * np.abs(H).max())
    assert cost(planes, T) == pytest.approx(float(small[f"cost_init_{case}"]), rel=1e-8)
    solution = solve(planes, T)
    assert solution.cost == pytest.approx(float(small[f"cost_opt_{case}"]), rel=1e-8)
    np.testing.assert_allclose(
        solution.T_world_camera, small[f"poses_opt_{case}"], rtol=0, atol=1e-6
    )
    trace = np.array([[t.before, t.after, t.damping] for t in solution.trials])
    np.testing.assert_allclose(trace, small[f"trace_r1_r2_u_{case}"], rtol=1e-6, atol=6e-7)


def scene(name: str) -> tuple[list[Floats], Floats]:
    with oracle("scenes_s0_s1.npz") as file:
        depths, T_true = file[f"depth_{name}"].astype(float), file[f"T_world_camera_{name}"]
        fx, cx, cy = (float(file[key]) for key in ("fx", "cx", "cy"))
    v, u = np.mgrid[: depths.shape[1], : depths.shape[2]]
    rays = np.stack([(u - cx) / fx, (v - cy) / fx, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    return [rays * depth.reshape(-1, 1) for depth in depths], T_true


def errors(T_est: Floats, T_true: Floats) -> Floats:
    """Mean absolute errors, mm and mrad, as the reference figures define them."""
    est, true = (se3.inverse(T[0]) @ T for T in (T_est, T_true))
    turn = se3.log_so3(np.swapaxes(est[1:, :3, :3], 1, 2) @ true[1:, :3, :3])
    return 1e3 * np.array([np.abs(est[1:, :3, 3] - true[1:, :3, 3]).mean(), np.abs(turn).mean()])


def perturbed(T: Floats, sigma_t: float, sigma_r: float, seed: int) -> Floats:
    off = np.random.default_rng(seed).normal(size=(len(T), 6)) * ([sigma_t] * 3 + [sigma_r] * 3)
    off[0] = 0.0
    return se3.retract(T, off)


FINE = {
    "points_across": 40.0,
    "rounds": 15,
    "least_share": 0.25,
    "reach": 0.25,
    "farthest": 1.0,
    "solver": SolverOptions(iterations=20, downhill=True),
}


def test_fixed_voxel_on_the_rough_scene_is_as_good_as_the_reference() -> None:
    clouds, T_true = scene("s0")
    found = []
    for seed in range(3):
        T = perturbed(T_true, 0.002, 0.003, seed)
        registered = schedules.register(clouds, T, Schedule((0.1,), 0.003), Stopwatch())
        found.append(errors(registered.T_world_camera, T_true))
    assert np.all(np.median(found, axis=0) < 1.5 * np.array([0.78, 1.5])), found


def test_coarse_to_fine_on_the_rough_scene_is_as_good_as_the_reference() -> None:
    clouds, T_true = scene("s0")
    # ten times the error that the reference started from
    T = perturbed(T_true, 0.02, 0.03, 0)
    fine = Schedule((0.16, 0.08, 0.04, 0.02), 0.002, **FINE)
    registered = schedules.register(clouds, T, fine, Stopwatch())
    assert [s.voxel for s in registered.stages] == [0.16, 0.08, 0.04, 0.02]
    assert not registered.refused
    assert np.all(errors(registered.T_world_camera, T_true) < 1.5 * np.array([0.07, 0.11]))


@pytest.mark.slow
def test_coarse_to_fine_on_the_noisy_scene_stops_before_it_fits_noise() -> None:
    clouds, T_true = scene("s1")
    T = perturbed(T_true, 0.02, 0.03, 0)
    # voxels so large that frames fall onto each other are passed over
    fine = Schedule((0.32, 0.16, 0.08, 0.04, 0.02), 0.002, **FINE)
    registered = schedules.register(clouds, T, fine, Stopwatch())
    assert [s.voxel for s in registered.stages] == [0.16, 0.08, 0.04]
    assert len(registered.refused) == 2
    assert np.all(errors(registered.T_world_camera, T_true) < [1.05, 1.7])


# -- finite differences and invariances ------------------------------------------------------------


@pytest.fixture(scope="module")
def random_planes() -> tuple[Planes, Floats]:
    """Blobs of points, flat and not, each seen by two to five of five frames."""
    rng = np.random.default_rng(0)
    T = se3.retract(np.tile(np.eye(4), (5, 1, 1)), rng.normal(size=(5, 6)) * 0.3)
    clusters, frame, feature = [], [], []
    for f in range(12):
        axes = se3.exp_so3(rng.normal(size=3)) * [0.2, 0.15, 0.01 if f % 3 else 0.1]
        centre = rng.normal(size=3)
        for k in np.sort(rng.choice(5, rng.integers(2, 6), replace=False)):
            count = rng.integers(8, 30)
            world = centre + rng.normal(size=(count, 3)) @ axes.T + 0.02 * rng.normal(size=3)
            points = transform(se3.inverse(T[k]), world)
            clusters.append(cluster_points(points, np.zeros(count, np.int64), 1)[0])
            frame.append(k)
            feature.append(f)
    planes = Planes(5, np.array(clusters), np.array(frame), np.array(feature), np.zeros(12, int))
    return planes, T


def test_gradient_and_hessian_are_the_derivatives(random_planes: tuple[Planes, Floats]) -> None:
    planes, T = random_planes
    found = linearise(planes, T)
    assert found.cost == pytest.approx(cost(planes, T), rel=1e-12)
    size = 6 * planes.frames

    def moved(x: Floats) -> Floats:
        return retract(T, x.reshape(-1, 6))

    h = 1e-5
    steps = h * np.eye(size)
    gradient = [(cost(planes, moved(x)) - cost(planes, moved(-x))) / (2 * h) for x in steps]
    np.testing.assert_allclose(found.J, gradient, atol=1e-7 * np.abs(found.J).max())
    # second derivatives along random directions: steps do not add up, so not by the gradient
    rng = np.random.default_rng(1)
    for _ in range(20):
        x = rng.normal(size=size) * rng.integers(0, 2, size)
        h = 1e-4
        bend = cost(planes, moved(h * x)) - 2 * found.cost + cost(planes, moved(-h * x))
        assert x @ found.H @ x == pytest.approx(bend / h**2, rel=1e-4, abs=1e-4)


def test_a_common_motion_changes_nothing(random_planes: tuple[Planes, Floats]) -> None:
    planes, T = random_planes
    rng = np.random.default_rng(2)
    together = se3.retract(np.eye(4), rng.normal(size=6))
    assert cost(planes, together @ T) == pytest.approx(cost(planes, T), rel=1e-10)
    found = linearise(planes, T)
    same = np.tile(rng.normal(size=6), planes.frames)
    assert abs(found.J @ same) < 1e-9 * np.linalg.norm(found.J) * np.linalg.norm(same)
    elsewhere, here = solve(planes, together @ T), solve(planes, T)
    assert elsewhere.cost <= cost(planes, T)
    np.testing.assert_allclose(elsewhere.T_world_camera[0], (together @ T)[0], atol=1e-12)
    np.testing.assert_allclose(here.T_world_camera[0], T[0], atol=1e-12)


def test_clusters_say_what_their_points_say() -> None:
    rng = np.random.default_rng(3)
    points, slot = rng.normal(size=(100, 3)), rng.integers(0, 4, 100)
    T = se3.retract(np.eye(4), rng.normal(size=6))
    moved = move_clusters(np.tile(T, (4, 1, 1)), cluster_points(points, slot, 4))
    whole = join_clusters(moved, np.array([0, 1, 0, 1]), 2)
    for k in range(2):
        mine = transform(T, points[slot % 2 == k])
        centre, covariance = covariances(whole)
        np.testing.assert_allclose(centre[k], mine.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(covariance[k], np.cov(mine.T, bias=True), atol=1e-12)


# -- planes and solver on made scenes --------------------------------------------------------------


def room(frames: int, sigma: float, seed: int = 0) -> tuple[list[Floats], Floats]:
    """Corners of three walls, 1 m wide, of which each frame sees other points."""
    rng = np.random.default_rng(seed)
    T = se3.retract(np.tile(np.eye(4), (frames, 1, 1)), rng.normal(size=(frames, 6)) * 0.2)
    clouds = []
    for k in range(frames):
        wall = rng.uniform(0.02, 0.98, size=(3, 3000, 3))
        for axis in range(3):
            wall[axis, :, axis] = 0.013 + sigma * rng.normal(size=3000)
        clouds.append(transform(se3.inverse(T[k]), wall.reshape(-1, 3)))
    return clouds, T


def test_recovers_poses_in_a_room_and_leaves_its_input_alone() -> None:
    clouds, T_true = room(4, 0.0005)
    T = perturbed(T_true, 0.01, 0.01, 1)
    before = T.copy()
    stages = Schedule((0.25, 0.125), 0.005, rounds=8)
    registered = schedules.register(clouds, T, stages, Stopwatch())
    np.testing.assert_array_equal(T, before)
    np.testing.assert_allclose(registered.T_world_camera[0], T_true[0], atol=1e-12)
    assert np.all(errors(registered.T_world_camera, T_true) < 0.1)


def test_frames_that_see_too_little_stay() -> None:
    clouds, T_true = room(4, 0.0005)
    clouds[2] = clouds[2][:0]
    T = perturbed(T_true, 0.005, 0.005, 1)
    registered = schedules.register(clouds, T, Schedule((0.25,), 0.005, rounds=8), Stopwatch())
    assert registered.stages[0].held == (2,)
    np.testing.assert_allclose(registered.T_world_camera[2], T[2], atol=1e-12)
    np.testing.assert_allclose(registered.T_world_camera[0], T[0], atol=1e-12)
    others = [0, 1, 3]
    assert np.all(errors(registered.T_world_camera[others], T_true[others]) < 0.2)


def test_no_planes_is_a_method_error() -> None:
    rng = np.random.default_rng(0)
    clouds = [rng.uniform(size=(500, 3)) for _ in range(3)]
    T = np.tile(np.eye(4), (3, 1, 1))
    with pytest.raises(MethodError, match="voxels of 100 mm: no frame sees 6 planes"):
        schedules.register(clouds, T, Schedule((0.1,), 0.01), Stopwatch())
    with pytest.raises(MethodError):
        schedules.register([c[:0] for c in clouds], T, Schedule((0.1,), 0.01), Stopwatch())


def test_the_reach_bounds_every_solution() -> None:
    clouds, T_true = room(4, 0.0005)
    T = perturbed(T_true, 0.03, 0.03, 1)
    planes = find_planes([thin(c, 0.005).astype(np.float32) for c in clouds], T, VoxelOptions(0.25))
    free, bound = solve(planes, T), solve(planes, T, SolverOptions(reach=0.005))
    assert displacement(planes, T, free.T_world_camera).max() > 0.006
    # frames are expressed relative to the first one afterwards, which adds its motion to theirs
    assert displacement(planes, T, bound.T_world_camera).max() < 0.011
    assert bound.cost < cost(planes, T)


def test_downhill_steps_lower_the_cost_where_the_hessian_is_not_definite() -> None:
    clouds, T_true = room(4, 0.0005)
    T = perturbed(T_true, 0.05, 0.1, 2)
    planes = find_planes([thin(c, 0.005).astype(np.float32) for c in clouds], T, VoxelOptions(0.5))
    start = linearise(planes, T)
    assert np.linalg.eigvalsh(start.H)[0] < -1e-3 * np.abs(start.H).max()
    downhill = solve(planes, T, SolverOptions(downhill=True))
    assert downhill.trials[0].after < downhill.trials[0].before
    assert downhill.cost < 0.5 * start.cost


def test_voxels_that_make_no_sense_are_refused() -> None:
    with pytest.raises(OptionError, match="voxel size 0"):
        VoxelOptions(0.0)
    with pytest.raises(OptionError, match="flatness"):
        VoxelOptions(0.1, flatness=())
    far = [np.array([[0.0, 0.0, 0.0], [1e9, 0.0, 0.0]], np.float32)] * 2
    planes = find_planes(far, np.tile(np.eye(4), (2, 1, 1)), VoxelOptions(0.001))
    assert len(planes) == 0 and planes.points == 0
