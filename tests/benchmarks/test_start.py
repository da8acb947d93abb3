"""How soon the command line answers: `--help` within 2.5 times what importing tyro takes."""

from __future__ import annotations

import subprocess
import sys

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

COMMANDS = {
    "import tyro": ["-c", "import tyro"],
    "depthba --help": ["-m", "depthba", "--help"],
    "depthba register --help": ["-m", "depthba", "register", "--help"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_start(benchmark: BenchmarkFixture, name: str) -> None:
    command = [sys.executable, *COMMANDS[name]]
    benchmark.pedantic(
        subprocess.run, (command,), {"capture_output": True, "check": True}, rounds=10
    )
