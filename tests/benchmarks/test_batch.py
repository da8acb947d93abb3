"""Two workers against one, in datasets a second. At least 1.7 times on an idle machine.

Each dataset takes the same work, so that both workers end together; what it costs to start them
is in it.
"""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

import sim
from sim.batch import generate_many
from sim.workers import cores

CASES = {
    "industrial-6": ("industrial-6", 8, sim.GenerateOptions(size=(640, 480), frames=12)),
    "heap": (
        "tests.sim.heaps:heap",
        48,
        sim.GenerateOptions(size=(160, 120), rig="gantry", sensor="sp1000"),
    ),
}


@pytest.mark.skipif(cores() < 2, reason="needs two cores")
@pytest.mark.parametrize("name", CASES)
def test_two_workers(benchmark: BenchmarkFixture, tmp_path: Path, name: str) -> None:
    scene, count, options = CASES[name]

    def make(workers: int) -> float:
        out = tmp_path / f"{workers}-{time.monotonic_ns()}"
        began = time.perf_counter()
        assert generate_many(scene, out, count, options, workers).done == count
        return time.perf_counter() - began

    generate_many(scene, tmp_path / "warm", 1, options, 1)  # compiles what is not yet compiled
    one = make(1)
    two = benchmark.pedantic(make, (2,), rounds=1)
    benchmark.extra_info["times one worker"] = round(one / two, 2)
    print(
        f"\n{name}: {one / two:.2f} x one worker ({count / one:.2f} datasets/s against "
        f"{count / two:.2f}, {count} datasets)"
    )
