"""The descent's parts as multiples of what NumPy takes to transform all points, in one run.

Compilation, reading, and what is found out about the outcome are left out. It wants an idle
machine, like `test_optimiser_pass.py`.
"""

from __future__ import annotations

import time
from itertools import pairwise

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

import depthba
from depthba.options import Options
from depthba.result import Iteration
from tests.benchmarks import sets


def test_descent(benchmark: BenchmarkFixture) -> None:
    """An iteration on maps of 5 and 1.25 cm, and all levels down to 2.5 and to 1.25 cm."""
    dataset = sets.beside("rock-field").dataset
    points = [f.points().astype(float) for f in dataset]
    poses = dataset.T_world_camera_measured

    def transform() -> float:
        began = time.perf_counter()
        for p, T in zip(points, poses, strict=True):
            p @ T[:3, :3].T + T[:3, 3]
        return time.perf_counter() - began

    def run() -> tuple[depthba.Result, list[tuple[float, Iteration]]]:
        ticks: list[tuple[float, Iteration]] = []
        result = depthba.register(
            dataset, Options(resolution=0.0125), lambda i: ticks.append((time.perf_counter(), i))
        )
        return result, ticks

    run()
    seconds = [transform() for _ in range(9)]
    result, ticks = benchmark.pedantic(run, rounds=1)
    unit = float(np.median([*seconds, *(transform() for _ in range(9))]))

    def iteration(spacing: float) -> float:
        apart = [
            after - before
            for (before, i), (after, j) in pairwise(ticks)
            if i.level == j.level and i.phase == j.phase and j.spacing == pytest.approx(spacing)
        ]
        # between some two of them patches are laid anew, or points weighed
        return float(np.quantile(apart, 0.25)) / unit

    stages = {
        name: s / unit
        for name, s in result.seconds.items()
        if name.startswith("level") or name == "patches"
    }
    finest = ticks[-1][1].level
    to_fine = sum(
        s for name, s in stages.items()
        if name.startswith("level") and not name.startswith(f"level {finest}")
    )  # fmt: skip
    found = {
        "an iteration at 5 cm": iteration(0.05),
        "an iteration at 1.25 cm": iteration(0.0125),
        "10, 5, 2.5 cm": to_fine,
        "10 to 1.25 cm, patches included": sum(stages.values()),
    }
    benchmark.extra_info.update({name: round(value, 1) for name, value in found.items()})
    print(f"\nNumPy transforms {sum(map(len, points)) / 1e6:.2f} M points in {1e3 * unit:.1f} ms")
    for name, value in found.items():
        print(f"  {name}: {value:.1f} x that")
    assert result.status != "not_converged"
