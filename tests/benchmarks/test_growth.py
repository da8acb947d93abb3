"""How time and memory grow with points, with frames and with cells of the map.

Each series varies one of them: points at equal frames and cells, cells at equal frames and points,
and frames, which bring their own points and cells with them as they cover more ground. Slopes are
of straight lines through the cases in log-log; memory counts from what a warm process holds. The
plot goes to docs/growth.png when all cases ran (BENCH_FULL=1), else to logs/bench/.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from tests.benchmarks import sets

STEEPEST = 1.15
# columns, rows, width, height, spacing (m)
Case = tuple[int, int, int, int, float]
SERIES: dict[str, list[Case]] = {
    # the map is fine enough for no points to be thinned out
    "points": [
        (4, 3, 160, 120, 0.007),
        (4, 3, 226, 170, 0.007),
        (4, 3, 320, 240, 0.007),
        (4, 3, 452, 340, 0.007),
    ],
    "frames": [
        (3, 2, 320, 240, 0.01),
        (4, 3, 320, 240, 0.01),
        (6, 4, 320, 240, 0.01),
        (8, 6, 320, 240, 0.01),
    ],
    "cells": [
        (4, 3, 320, 240, 0.012),
        (4, 3, 320, 240, 0.008),
        (4, 3, 320, 240, 0.0056),
        (4, 3, 320, 240, 0.004),
    ],
}
if sets.FULL:
    SERIES["frames"].append((12, 8, 320, 240, 0.01))
    SERIES["cells"].append((4, 3, 320, 240, 0.0028))
    SERIES["points"].insert(0, (4, 3, 112, 84, 0.007))
LARGEST: Case = (20, 10, 320, 240, 0.0046)
GIGABYTES = 8.0


def run_case(case: Case, where: Path) -> dict[str, Any]:
    """Run a case in its own process."""
    words = [*map(str, case), str(sets.folder(where) / "growth")]
    done = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks.growth_case", *words],
        capture_output=True, text=True, cwd=sets.ROOT, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    print(
        f"  {found['frames']:4} frames {found['points'] / 1e6:6.2f} M points "
        f"{found['cells'] / 1e3:7.0f} k cells: {found['seconds_an_iteration']:7.3f} s an iteration,"
        f" {found['seconds']:7.2f} s in all, {found['gigabytes']:6.3f} GB"
    )
    return found


def slope(rows: list[dict[str, Any]], against: str, of: str) -> float:
    """Return the slope of a straight line in log-log."""
    x, y = (np.log([row[key] for row in rows]) for key in (against, of))
    return float(np.polyfit(x, y, 1)[0])


def test_growth(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    print()

    def measure() -> dict[str, list[dict[str, Any]]]:
        return {
            name: [run_case(case, tmp_path) for case in cases] for name, cases in SERIES.items()
        }

    found = benchmark.pedantic(measure, rounds=1)
    sets.keep("growth", [{"series": name, "cases": rows} for name, rows in found.items()])
    steep = {}
    for name, rows in found.items():
        slopes = {
            of: slope(rows, name, of) for of in ("seconds_an_iteration", "seconds", "gigabytes")
        }
        steep[name] = slopes["gigabytes"]
        print(
            f"{name}: slopes {slopes['seconds_an_iteration']:.2f} (seconds an iteration), "
            f"{slopes['seconds']:.2f} (seconds in all), {slopes['gigabytes']:.2f} (memory)"
        )
    plot(found, sets.ROOT / ("docs" if sets.FULL else "logs/bench") / "growth.png")
    assert max(steep.values()) <= STEEPEST, steep


@pytest.mark.skipif(not sets.FULL, reason="only with BENCH_FULL=1: takes minutes")
def test_the_largest(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    """200 frames of 77k points on a million cells."""
    print()
    found = benchmark.pedantic(run_case, (LARGEST, tmp_path), rounds=1)
    sets.keep("growth-largest", [found])
    assert found["cells"] > 0.95e6 and found["points"] > 15e6
    assert found["gigabytes_in_all"] <= GIGABYTES


def plot(found: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Draw time and memory of each series, with lines of slope 1 to compare with."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    quantities = {
        "seconds_an_iteration": ("CPU s an iteration", "tab:blue"),
        "seconds": ("CPU s in all", "tab:orange"),
        "gigabytes": ("GB, beyond the empty process", "tab:green"),
    }
    units = {"points": (1e6, "million points"), "frames": (1, "frames"), "cells": (1e3, "k cells")}
    figure, axes = plt.subplots(1, 3, figsize=(12, 4.6), sharey=True)
    for axis, (name, rows) in zip(axes, found.items(), strict=True):
        unit, label = units[name]
        x = np.array([row[name] for row in rows]) / unit
        for of, (words, colour) in quantities.items():
            y = np.array([row[of] for row in rows])
            axis.loglog(
                x, y, "o-", color=colour, label=f"{words}: slope {slope(rows, name, of):.2f}"
            )
            axis.loglog(x, y[0] * x / x[0], ":", color=colour, linewidth=1)
        axis.set_xticks(x, [f"{v:.3g}" for v in x])
        axis.set_xticks([], minor=True)
        axis.set_xlabel(label)
        axis.grid(True, which="both", alpha=0.25)
        axis.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.15), frameon=False)
    axes[0].set_title("12 frames, equal cells", fontsize=10)
    axes[1].set_title("frames with their own ground", fontsize=10)
    axes[2].set_title("12 frames, equal points", fontsize=10)
    figure.suptitle("Growth of a registration (dotted: slope 1)")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
