"""One case of test_growth.py, in a process of its own, so that its peak memory is its own.

``python -m tests.benchmarks.growth_case COLUMNS ROWS WIDTH HEIGHT SPACING FOLDER`` registers a
relief and prints a line of JSON. Starts are so near that there is one level, and iterations are
few and equally many, so that cases differ by their size alone. Times are of the process's CPU,
reading and the covariance included: other processes do not count.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import depthba
from depthba.options import Options
from tests.benchmarks.relief import Relief

ITERATIONS = 3


def peak() -> float:
    """Return the largest memory that this process has held, GB."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    line = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024**2


def main(words: list[str]) -> None:
    """Run the case."""
    columns, rows, width, height = map(int, words[:4])
    spacing, folder = float(words[4]), Path(words[5])
    options = Options(resolution=spacing, max_iterations=ITERATIONS, prior_t=0.0002, prior_r=0.0002)
    small = Relief(columns=2, rows=1, size=(64, 48), start_error=(2e-4, 2e-4))
    depthba.register(small.write(folder / "warm"), options)
    before = peak()
    relief = Relief(columns=columns, rows=rows, size=(width, height), start_error=(2e-4, 2e-4))
    dataset = relief.write(folder / f"{columns}x{rows}-{width}x{height}")
    began, ticks = time.process_time(), [0.0]
    result = depthba.register(dataset, options, lambda _: ticks.append(time.process_time()))
    spent = time.process_time() - began
    iterations = len(result.history)
    found = {
        "frames": columns * rows,
        "points": sum(f.points for f in result.frames),
        "cells": int(result.depth_map.heights.size),
        "iterations": iterations,
        "seconds_an_iteration": (ticks[-1] - ticks[1]) / (iterations - 1),
        "seconds": spent,
        "gigabytes": peak() - before,
        "gigabytes_in_all": peak(),
        "stages": result.seconds,
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1:])
