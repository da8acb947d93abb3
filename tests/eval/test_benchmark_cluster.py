"""The benchmark on many machines: a worker is killed and one comes, and the report is the same."""

from __future__ import annotations

import contextlib
import json
import os
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from eval.benchmark.warming import small_dataset
from tests.processes import command, dask_scheduler, dask_worker, until

pytest.importorskip("distributed", reason="needs depthba[distributed]")
pytestmark = pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")

COUNTS = "tests.eval.odd_methods:Counts"
# What hangs on the hour, the machine and the words of the command.
PASSING = {"seconds", "total_seconds", "memory_bytes", "memory", "command"}


def lasting(value: Any) -> Any:
    """Return what a report says that another run must say, too."""
    if isinstance(value, dict):
        return {k: lasting(v) for k, v in value.items() if k not in PASSING}
    return [lasting(v) for v in value] if isinstance(value, list) else value


def words(datasets: list[Path], methods: str, out: Path, *more: str) -> list[str]:
    """Return a benchmark's command."""
    paths = [str(path) for path in datasets]
    return [
        "depthba",
        "benchmark",
        "--datasets",
        *paths,
        "--methods",
        methods,
        "--out",
        str(out),
        *more,
    ]


def check(folder: Path, count: int, methods: str) -> None:
    """Run a benchmark on a cluster with losses and gains, and plainly; compare the reports."""
    data, cluster, plain = (folder / name for name in ("data", "cluster", "plain"))
    data.mkdir()
    datasets = [small_dataset(data / f"waves-{k}").path for k in range(count)]
    log = data / "runs.txt"

    def lines() -> list[list[str]]:
        return [line.split() for line in log.read_text().splitlines()] if log.exists() else []

    with contextlib.ExitStack() as stack:
        address = stack.enter_context(dask_scheduler(folder))
        worker = dask_worker(address, folder / "dask")
        doomed = stack.enter_context(command(*worker))
        others = [stack.enter_context(command(*worker))]
        asked = stack.enter_context(
            command(*words(datasets, methods, cluster, "--scheduler", address))
        )
        until(lambda: [str(doomed.pid), "began"] in [line[1:] for line in lines()], "a start")
        doomed.kill()
        others.append(stack.enter_context(command(*worker)))
        assert asked.wait(300) == 0
    found = lines()
    # each was ended once, whoever had begun it, and by those that lived
    ended = Counter(name for name, _, what in found if what == "ended")
    assert ended == {path.name: 1 for path in datasets}
    died = [name for name, who, what in found if int(who) == doomed.pid and what == "began"]
    finished = [name for name, who, what in found if int(who) == doomed.pid and what == "ended"]
    assert len(died) == len(finished) + 1  # it was in the midst of one
    assert {int(who) for _, who, what in found if what == "ended"} <= {
        doomed.pid, *(process.pid for process in others),
    }  # fmt: skip
    log.unlink()
    with command(*words(datasets, methods, plain, "--workers", "1")) as process:
        assert process.wait(300) == 0
    one, other = (json.loads((out / "results.json").read_text()) for out in (cluster, plain))
    assert lasting(one) == lasting(other)
    assert len(one["outcomes"]) == count * len(methods.split(","))
    assert {o["status"] for o in one["outcomes"]} == {"done"}
    for path in datasets:
        for method in methods.split(","):
            at = Path(path.name) / method / "poses.txt"
            assert (cluster / at).read_bytes() == (plain / at).read_bytes()
    assert not list(cluster.rglob("request.json"))


def test_a_worker_is_lost_and_one_comes(tmp_path: Path) -> None:
    check(tmp_path, 3, COUNTS)


@pytest.mark.slow
def test_a_worker_is_lost_and_one_comes_among_real_methods(tmp_path: Path) -> None:
    check(tmp_path, 8, f"initial,gicp-pgo,depthba,{COUNTS}")
