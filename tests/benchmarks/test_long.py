"""Long and large: memory of live registration over time, and of one registration stage by stage.

Live: frames come without a pause, session after session; what is held when a session has as many
frames as another must be the same. ``BENCH_LIVE`` is for how many seconds (60). Large: 500 frames
of 1.5 million points in all, with ``BENCH_FULL=1`` of 40 million. The plot goes to docs/long.png
with ``BENCH_FULL=1``, else to logs/bench/.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from tests.benchmarks import sets

SECONDS = float(os.environ.get("BENCH_LIVE", "60"))
FRAMES = 20
# columns, rows, width, height
MANY = (25, 20, 64, 48)
LARGE = (25, 20, 328, 246)
GIGABYTES = 8.0
# From session to session after the first, memory at equal numbers of frames may grow by this, GB:
# what the allocator keeps.
FLAT = 0.01


def lines_of(module: str, *words: object) -> list[dict[str, Any]]:
    """Run a case in its own process."""
    done = subprocess.run(
        [sys.executable, "-m", f"tests.benchmarks.{module}", *map(str, words)],
        stdout=subprocess.PIPE, text=True, cwd=sets.ROOT, check=True,
    )  # fmt: skip
    return [json.loads(line) for line in done.stdout.splitlines()]


def growth_per_session(rows: list[dict[str, Any]]) -> float:
    """Return the slope of memory over sessions at equal numbers of frames, GB; none of the first.

    The median over the numbers of frames.
    """
    slopes = []
    for frames in {row["frames"] for row in rows}:
        same = [(r["session"], r["gigabytes"]) for r in rows if r["frames"] == frames]
        x, y = np.array([pair for pair in same if pair[0] > 0]).reshape(-1, 2).T
        if len(x) > 1:
            slopes.append(np.polyfit(x, y, 1)[0])
    return float(np.median(slopes)) if slopes else float("nan")


def test_live_registration_holds_no_more_with_time(
    benchmark: BenchmarkFixture, tmp_path: Path
) -> None:
    rows = benchmark.pedantic(
        lines_of, ("long_case", SECONDS, FRAMES, sets.folder(tmp_path) / "long"), rounds=1
    )
    sets.keep("long-live", rows)
    slope = growth_per_session(rows)
    print(f"\n{len(rows)} frames in {rows[-1]['session'] + 1} sessions, {1e3 * slope:.2f} MB each")
    plot(rows, None, sets.ROOT / "logs/bench/long.png")
    assert not slope > FLAT


def test_many_frames(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    case = LARGE if sets.FULL else MANY
    (found,) = benchmark.pedantic(
        lines_of, ("batch_case", *case, sets.folder(tmp_path) / "long"), rounds=1
    )
    sets.keep("long-large", [found])
    print()
    for stage, (seconds, gigabytes) in found["stages"].items():
        print(f"  {stage:24} {seconds:8.1f} s {gigabytes:6.2f} GB")
    assert found["frames"] == 500 and found["gigabytes"] <= GIGABYTES


@pytest.mark.skipif(not sets.FULL, reason="only with BENCH_FULL=1")
def test_plot(benchmark: BenchmarkFixture) -> None:
    """Both, as they were measured last."""
    folder = sets.ROOT / "logs/bench"
    live, large = (
        json.loads((folder / f"long-{name}.json").read_text()) for name in ("live", "large")
    )
    target = sets.ROOT / "docs/long.png"
    benchmark.pedantic(plot, (live, large[0], target), rounds=1)
    assert target.stat().st_size > 10_000


def plot(live: list[dict[str, Any]], large: dict[str, Any] | None, path: Path) -> None:
    """Draw memory over time and by the number of frames, and stage by stage."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3 if large else 2, figsize=(13 if large else 9, 4))
    minutes = [row["seconds"] / 60 for row in live]
    held = [1e3 * row["gigabytes"] for row in live]
    axes[0].plot(minutes, held, linewidth=1)
    axes[0].set(xlabel="minutes of live registration", ylabel="memory held, MB", ylim=(0, None))
    sessions = sorted({row["session"] for row in live})
    for session in sessions:
        rows = [row for row in live if row["session"] == session]
        colour = plt.get_cmap("viridis")(session / max(sessions[-1], 1))
        axes[1].plot(
            [r["frames"] for r in rows], [1e3 * r["gigabytes"] for r in rows], color=colour
        )
    axes[1].set(
        xlabel="frames of a session (dark: the first)", ylabel="memory held, MB", ylim=(0, None)
    )
    if large:
        names = list(large["stages"])
        axes[2].barh(names[::-1], [large["stages"][n][1] for n in names[::-1]], color="tab:green")
        axes[2].set(
            xlabel="most memory so far, GB",
            title=f"{large['frames']} frames, {large['points'] / 1e6:.1f} M points, by stage",
        )
    for axis in axes:
        axis.grid(True, alpha=0.25)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
