"""The pass over the points, as a multiple of what NumPy takes to transform them, in one run.

It wants an idle machine: NumPy's threads wait for each other where a core is taken, and the
ratio then flatters the pass.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from depthba.optimiser.grid import average, filled, make_grid
from depthba.optimiser.linearise import Loss, State, Workers, linearise
from depthba.optimiser.problem import Problem
from tests.depthba.optimiser_problems import looking_down, problem_of, view

FRAMES, POINTS, SPACING = 12, 76_800, 0.005
LOSSES = {
    "vertical": Loss(False, False, 0.0, 2 * SPACING, 0.0, 0.1),
    "range": Loss(True, True, 0.004, 2 * SPACING, 0.004**2, 0.01),
}


@pytest.fixture(scope="module")
def problem() -> Problem:
    rng = np.random.default_rng(0)
    T = looking_down(FRAMES, rng, tilt=0.1)
    clouds = []
    for pose in T:
        p = view(pose, lambda x, y: 0.02 * np.sin(17 * x) * np.cos(13 * y), POINTS, rng)
        # in the order of an image, as a sensor gives them
        p = p[np.lexsort((p[:, 0], np.round(p[:, 1] / 0.0025)))]
        noise = 1 + 0.001 * rng.standard_normal((POINTS, 1))
        clouds.append(np.column_stack([p * noise, np.ones((POINTS, 2))]))
    return problem_of(clouds, T, SPACING)


def median_seconds(work: Callable[[], object], rounds: int = 15) -> float:
    work()
    seconds = []
    for _ in range(rounds):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


@pytest.mark.parametrize("name", LOSSES)
def test_pass(benchmark: BenchmarkFixture, problem: Problem, name: str) -> None:
    grid = make_grid(problem, SPACING, 2 * SPACING)
    T, workers = problem.T_map_camera, Workers(2)
    state = State(T, filled(average(problem, T, grid).heights))
    smooth = np.ones(grid.shape, bool)
    frames = [f.points.astype(float) for f in problem.frames]
    transform = median_seconds(
        lambda: [p @ pose[:3, :3].T + pose[:3, 3] for p, pose in zip(frames, T, strict=True)]
    )
    loss = LOSSES[name]
    seconds = median_seconds(lambda: linearise(problem, grid, state, loss, workers, smooth))
    benchmark(linearise, problem, grid, state, loss, workers, smooth)
    workers.close()
    ratio = seconds / transform
    benchmark.extra_info["times the NumPy transform"] = round(ratio, 2)
    points = FRAMES * POINTS
    print(
        f"\n{name}: {ratio:.2f} x the NumPy transform "
        f"({1e3 * seconds:.1f} ms against {1e3 * transform:.1f} ms, {points / seconds / 1e6:.0f} "
        f"million points/s, {grid.shape[1]} x {grid.shape[0]} nodes)"
    )
