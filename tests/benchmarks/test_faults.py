"""Faults of the rig end within 5 s: its tests of them once more, with that for a limit."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from pytest_benchmark.fixture import BenchmarkFixture

ROOT = Path(__file__).parents[2]
SECONDS = 5.0
TESTS = ("test_ur_arm_faults", "test_capture_faults", "test_axes", "test_axes_grbl")


def test_faults_end_in_five_seconds(benchmark: BenchmarkFixture) -> None:
    command = [sys.executable, "-m", "pytest", "-q", *(f"tests/rig/{name}.py" for name in TESTS)]
    environment = {**os.environ, "FAULT_SECONDS": str(SECONDS)}

    def run() -> subprocess.CompletedProcess[str]:
        return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)

    done = benchmark.pedantic(run, rounds=1)
    assert done.returncode == 0, done.stdout[-3000:]
