"""The fixed pattern of a camera: its normal equations, that it is found, that none is made up."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import depthba
from depthba.dataset import Dataset
from depthba.optimiser import pattern, reduced
from depthba.optimiser.feet import Ground
from depthba.optimiser.grid import make_grid
from depthba.optimiser.linearise import Linearisation, Loss, State, linearise
from depthba.optimiser.problem import Problem, prepare
from depthba.optimiser.waves import waves_of
from depthba.optimiser.workers import Workers
from depthba.options import Options
from tests.depthba.analytic_scene import (
    HEIGHT,
    WIDTH,
    Floats,
    bumpy,
    pose_errors,
    truth_of,
    write_scene,
)

LOSS = Loss(True, True, 0.0, 0.1, 0.0, 0.05)
FRAMES, NOISE, STRENGTH = 8, 0.0005, 0.0005


def image_places() -> Floats:
    u, v = np.meshgrid((np.arange(WIDTH) + 0.5) / WIDTH, (np.arange(HEIGHT) + 0.5) / HEIGHT)
    return np.stack([u.ravel(), v.ravel()])


def bend_of(dataset: Dataset) -> Floats:
    """Return (HEIGHT, WIDTH), m, an error of the range."""
    waves = waves_of(dataset.sensor, NOISE)
    assert waves is not None
    strengths = STRENGTH * np.random.default_rng(1).standard_normal(len(waves))
    return (waves.over_image(*image_places()) @ strengths).reshape(HEIGHT, WIDTH)


@pytest.fixture(scope="module")
def white(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    path = tmp_path_factory.mktemp("white") / "scene"
    return write_scene(path, frames=FRAMES, noise=NOISE)


@pytest.fixture(scope="module")
def bent(white: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The same views, all with one error of the range."""
    path = tmp_path_factory.mktemp("bent") / "scene"
    return write_scene(path, frames=FRAMES, noise=NOISE, bend=bend_of(white))


def test_waves_are_as_large_as_stated_and_hold_no_tilt(white: Dataset) -> None:
    waves = waves_of(white.sensor, NOISE)
    assert waves is not None
    u, v = image_places()
    out = waves.over_image(u, v)
    assert out.shape == (WIDTH * HEIGHT, len(waves))
    assert_allclose(np.sqrt(np.mean(out**2, axis=0)), 1.0, atol=0.02)
    plain = np.stack([np.ones_like(u), u - 0.5, v - 0.5], axis=1)
    assert np.abs(np.linalg.lstsq(plain, out, rcond=None)[0]).max() < 0.02
    points = white[0].points()
    assert_allclose(waves.at(points), out, atol=1e-4)


def test_a_sensor_without_rays_has_none(white: Dataset) -> None:
    assert waves_of(replace(white.sensor, camera=None), NOISE) is None


def linearised(dataset: Dataset) -> tuple[Problem, State, Linearisation]:
    problem = prepare(dataset, truth_of(dataset), None)
    grid = make_grid(problem, 0.03, 0.06)
    x, y = np.meshgrid(*(grid.origin[k] + 0.03 * np.arange(grid.shape[1 - k]) for k in (0, 1)))
    state = State(problem.T_map_camera, bumpy(x, y)[0])
    lin = linearise(problem, grid, state, LOSS, Workers(1), np.ones(grid.shape, bool))
    return problem, state, lin


def test_normal_equations_against_finite_differences(bent: Dataset) -> None:
    problem, state, lin = linearised(bent)
    waves, workers = problem.waves, Workers(1)
    assert waves is not None
    grid = make_grid(problem, 0.03, 0.06)
    smooth = np.ones(grid.shape, bool)
    at = reduced.reduce(lin, workers)
    found = pattern.answers(problem, grid, state, LOSS, lin, at, waves, workers)
    m, delta = len(waves), 1e-4
    by_pose, by_map, cost = [], [], []
    for k in range(m):
        minus, plus = (
            linearise(
                pattern.without(problem, sign * delta * np.eye(m)[k]), grid, state, LOSS, workers,
                smooth,
            )
            for sign in (-1, 1)
        )  # fmt: skip
        by_pose.append((plus.g_pose - minus.g_pose).ravel() / (2 * delta))
        by_map.append((plus.g_map - minus.g_map).ravel() / (2 * delta))
        cost.append([(plus.cost - minus.cost) / (4 * delta),
                     (plus.cost - 2 * lin.cost + minus.cost) / (2 * delta**2)])  # fmt: skip
    cross, coupled = np.stack(by_pose, axis=1), np.stack(by_map, axis=1)
    own_gradient, own_diagonal = np.array(cost).T
    B = np.zeros((6 * len(lin.B), lin.g_map.size))
    for i, foot in enumerate(lin.B):
        rows = np.zeros((*grid.shape, 6))
        rows[foot.window] = foot.values
        B[6 * i : 6 * i + 6] = rows.reshape(-1, 6).T
    through = np.linalg.solve(lin.C.sparse().toarray(), coupled)
    size = np.abs(own_diagonal).max()
    own = own_diagonal - np.einsum("nk,nk->k", coupled, through)
    assert_allclose(np.diag(found.own), own, atol=2e-3 * size)
    assert_allclose(found.own, found.own.T)
    reference = cross - B @ through
    assert_allclose(found.cross, reference, atol=2e-3 * np.abs(cross).max())
    gradient = own_gradient - through.T @ lin.g_map.ravel()
    # the map's answers are loose, and the map here is not solved for: hence the tolerance
    assert_allclose(found.gradient, gradient, atol=2e-2 * np.abs(own_gradient).max())


def test_scores_of_groups_add_up_to_the_gradient(bent: Dataset) -> None:
    problem, state, lin = linearised(bent)
    waves, workers = problem.waves, Workers(2)
    assert waves is not None
    grid = make_grid(problem, 0.03, 0.06)
    at = reduced.reduce(lin, workers)
    found = pattern.answers(problem, grid, state, LOSS, lin, at, waves, workers)
    ground = Ground(problem, grid, state, LOSS)
    groups = [np.stack([f.blocks, np.zeros_like(f.blocks)]) for f in problem.frames]
    scores = pattern.scores(ground, lin, waves, found, groups, 48, workers)
    # smoothing has a share in the map's gradient that no point has
    total = scores.sum(axis=1)
    assert_allclose(total[0], total[1], rtol=1e-6, atol=1e-9 * np.abs(total).max())
    assert_allclose(total[0], found.gradient, atol=0.02 * np.abs(found.gradient).max())


def test_a_pattern_is_found_and_taken_off(bent: Dataset) -> None:
    truth = truth_of(bent)
    with_it = depthba.register(bent, Options(threads=1))
    without = depthba.register(bent, Options(threads=1, fixed_pattern=False))
    found, missed = (pose_errors(r.T_world_camera, truth) for r in (with_it, without))
    assert found[0] < 0.5 * missed[0]
    assert found[1] < 0.5 * missed[1]


def test_where_there_is_none_nothing_is_made_up(white: Dataset) -> None:
    one = depthba.register(white, Options(threads=1))
    other = depthba.register(white, Options(threads=1, fixed_pattern=False))
    assert_array_equal(one.T_world_camera, other.T_world_camera)
    assert_array_equal(one.covariance, other.covariance)


def test_what_only_some_frames_have_is_not_the_pattern_of_the_camera(
    bent: Dataset, tmp_path: Path
) -> None:
    """Two cameras, taken for one: no pattern makes the frames of both agree."""
    mixed = tmp_path / "mixed"
    shutil.copytree(bent.path, mixed)
    other = write_scene(tmp_path / "other", frames=FRAMES, noise=NOISE, bend=-bend_of(bent))
    lines = [(d / "frames.jsonl").read_text().splitlines() for d in (bent.path, other.path)]
    for frame in other.frames[5:]:
        stored = frame.files["depth"].path
        shutil.copy(other.path / stored, mixed / stored)
    (mixed / "frames.jsonl").write_text("\n".join(lines[0][:5] + lines[1][5:]) + "\n")
    dataset = Dataset.open(mixed)
    noise = dataset.sensor.noise
    assert noise is not None
    little = replace(noise, sigma_m=noise.sigma_m / 20)
    dataset = replace(dataset, sensor=replace(dataset.sensor, noise=little))
    result = depthba.register(dataset, Options(threads=1))
    assert result.fixed_pattern == 0.0
    assert result.refused_pattern > 2 * little.sigma_m
    plain = depthba.register(dataset, Options(threads=1, fixed_pattern=False))
    assert_array_equal(result.T_world_camera, plain.T_world_camera)
    # one that all frames have is believed whatever the sensor states
    true = depthba.register(
        replace(bent, sensor=replace(bent.sensor, noise=little)), Options(threads=1)
    )
    assert true.fixed_pattern > 0.0 and true.refused_pattern == 0.0


def test_the_strength_is_that_of_the_waves() -> None:
    rng = np.random.default_rng(0)
    own = np.diag(np.geomspace(1e6, 1e10, 60))
    bend = 0.003 * rng.standard_normal(60)
    variance = 12.0
    call = own @ bend + np.sqrt(variance * np.diag(own)) * rng.standard_normal(60)
    found = pattern.Answers(own, np.zeros((6, 60)), -call, np.zeros((1, 1, 60), np.float32))
    keep = np.ones(6, bool)
    believed = pattern.believe(found, np.eye(6), keep, np.zeros(60), variance)
    assert believed.strength == pytest.approx(0.003, rel=0.3)
    error = believed.pattern - bend
    normalised = error[-30:] ** 2 * np.diag(own)[-30:] / variance
    assert 0.5 < np.mean(normalised) < 1.6
    # noise alone
    call = np.sqrt(variance * np.diag(own)) * rng.standard_normal(60)
    found = replace(found, gradient=-call)
    none = pattern.believe(found, np.eye(6), keep, np.zeros(60), variance)
    assert none.strength == 0.0
    assert_array_equal(none.pattern, 0.0)
    assert_array_equal(none.inverse, 0.0)
