"""One registration of many frames, in a process of its own: ``COLUMNS ROWS WIDTH HEIGHT FOLDER``.

Prints a line of JSON: seconds and most memory (GB, so far) at the end of every stage.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import depthba
from depthba.optimiser.clock import Clock
from depthba.options import Options
from tests.benchmarks.growth_case import peak
from tests.benchmarks.relief import Relief

STAGES: dict[str, list[float]] = {}


def watched(clock: Clock, stage: str, lap: Callable[[Clock, str], None] = Clock.lap) -> None:
    """Note how much memory was held at most when a stage ends."""
    lap(clock, stage)
    STAGES[stage] = [clock.stages[stage], peak()]
    print(f"{stage}: {clock.stages[stage]:.1f} s, {peak():.2f} GB", file=sys.stderr, flush=True)


def main(words: list[str]) -> None:
    """Run the case."""
    columns, rows, width, height = map(int, words[:4])
    relief = Relief(columns=columns, rows=rows, size=(width, height), start_error=(2e-3, 2e-3))
    dataset = relief.write(Path(words[4]) / f"{columns}x{rows}-{width}x{height}")
    before = peak()
    Clock.lap = watched  # type: ignore[method-assign]
    result = depthba.register(dataset, Options(prior_t=0.002, prior_r=0.002))
    found = {
        "frames": columns * rows,
        "points": sum(f.points for f in result.frames),
        "nodes": int(result.depth_map.heights.size),
        "status": result.status,
        "seconds": result.seconds["total"],
        "gigabytes_before": before,
        "gigabytes": peak(),
        "stages": STAGES,
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1:])
