"""Datasets in great number: the same bytes whoever makes them, and whatever is killed meanwhile."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import pytest

import sim
from depthba.dataset import verify
from depthba.errors import DepthbaError, OptionError
from sim.batch import Failure, generate_many
from tests.processes import command, dask_scheduler, dask_worker, until
from tests.sim import heaps

pytestmark = pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")

HEAP, TROUBLED = "tests.sim.heaps:heap", "tests.sim.heaps:troubled"
OPTIONS = sim.GenerateOptions(frames=3, size=(64, 48), rig="gantry", sensor="sp1000")
WORDS = ["--frames", "3", "--size", "64x48", "--rig", "gantry", "--sensor", "sp1000"]
COUNT = 6

Tree = dict[str, bytes]


def tree(path: Path) -> Tree:
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> Tree:
    """The datasets as they come out one by one, in another order."""
    out = tmp_path_factory.mktemp("one-by-one")
    for seed in (3, 0, 5, 1, 4, 2):
        sim.generate(HEAP, out / f"heap-{seed:06d}", replace(OPTIONS, seed=seed))
    return tree(out)


def batch(out: Path, *words: str, scene: str = HEAP, count: int = COUNT) -> list[str]:
    return ["depthba", "generate", scene, "--out", str(out), "--count", str(count), *WORDS, *words]


def committed(out: Path) -> int:
    return sum(file.read_bytes().count(b"\n") for file in out.glob("*/frames.jsonl"))


def gone(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


def test_bytes_hang_on_the_seed_alone(expected: Tree, tmp_path: Path) -> None:
    said: list[tuple[int, int]] = []
    report = generate_many(
        HEAP, tmp_path, COUNT, OPTIONS, workers=2, progress=lambda k, n, text: said.append((k, n))
    )
    assert (report.done, report.skipped, report.failed) == (COUNT, 0, ())
    assert tree(tmp_path) == expected and all(verify(path) == [] for path in tmp_path.iterdir())
    assert said[0] == (0, COUNT) and said[-1] == (COUNT, COUNT) and said == sorted(said)
    again = generate_many(HEAP, tmp_path, COUNT, OPTIONS)
    assert (again.done, again.skipped) == (0, COUNT) and tree(tmp_path) == expected


def test_what_fails_is_tried_again_then_listed_and_the_rest_go_on(
    expected: Tree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, tries = tmp_path / "out", tmp_path / "tries"
    tries.mkdir()
    monkeypatch.setenv(heaps.TROUBLE, str(tries))
    report = generate_many(TROUBLED, out, COUNT, OPTIONS, workers=2, retries=1)
    assert (report.done, report.skipped) == (4, 0)
    (one, three) = report.failed
    assert one.seed == 1
    assert one.error.startswith("ArithmeticError: the heap falls over (heaps.py:")
    assert three == Failure(3, "its process was killed, or crashed")
    assert {int(file.name): len(file.read_text()) for file in tries.iterdir()} == {
        0: 1, 1: 2, 2: 2, 3: 2, 4: 2, 5: 1
    }  # fmt: skip
    line = report.line(most=1)
    assert "2 of 6 datasets failed: seed 1 (Arith" in line and line.endswith("and seeds 3")
    images = {name for name in expected if name.endswith(".png") and name[10] not in "13"}
    made = tree(out)
    assert {name: made[name.replace("heap", "troubled")] for name in images} == {
        name: expected[name] for name in images
    }
    assert not (out / ".locks").exists()


@pytest.mark.parametrize(
    "kills", [["one"], pytest.param(["all", "one", "all"], marks=pytest.mark.slow)]
)
def test_killed_and_given_again_all_is_as_if_undisturbed(
    kills: list[str], expected: Tree, tmp_path: Path
) -> None:
    """Either all of its processes are killed, or the first, whose end the others notice."""
    moments = random.Random(7)
    goal = 0
    for kill in kills:
        goal += moments.randrange(2, 5)
        with command(*batch(tmp_path, "--workers", "2")) as process:
            until(lambda: committed(tmp_path) >= goal, f"{goal} frames")  # noqa: B023
            time.sleep(moments.uniform(0.0, 0.02))
            if kill == "all":
                os.killpg(process.pid, signal.SIGKILL)
            process.kill()
            process.wait()
            until(lambda: gone(process.pid), "the end of the others", 30.0)
        assert committed(tmp_path) < COUNT * 3
    with command(*batch(tmp_path, "--workers", "1")) as process:
        assert process.wait() == 0
    assert tree(tmp_path) == expected
    assert all(verify(path) == [] for path in tmp_path.iterdir())


def test_a_second_batch_is_refused_and_ctrl_c_ends_the_first(tmp_path: Path) -> None:
    words = batch(tmp_path, "--workers", "2", count=500)
    with command(*words, stderr=subprocess.PIPE) as process:
        until(lambda: committed(tmp_path) > 4, "frames")
        with pytest.raises(DepthbaError, match=f"process {process.pid} on .* is generating here"):
            generate_many(HEAP, tmp_path, 2, OPTIONS)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        assert process.stderr is not None
        told = process.stderr.read()
        assert process.wait() == 130
        assert told.endswith("depthba: interrupted\n") and "Traceback" not in told
        until(lambda: gone(process.pid), "the end of the others", 30.0)
    begun = [path for path in tmp_path.iterdir() if (path / "dataset.json").exists()]
    assert 2 <= len(begun) < 500 and all(verify(path) == [] for path in begun)
    assert generate_many(HEAP, tmp_path, 1, OPTIONS).failed == ()
    assert not (tmp_path / ".locks").exists()


def test_what_could_never_be_made_is_refused_at_once(tmp_path: Path) -> None:
    for wrong, text in (
        ({"count": 0}, "count 0"),
        ({"workers": 0}, "workers 0"),
        ({"retries": -1}, "retries -1"),
        ({"scene": "moon"}, "'moon'"),
        ({"workers": 1, "scheduler": "tcp://127.0.0.1:1"}, "workers 1"),
        ({"scheduler": "there"}, "scheduler 'there'"),
        ({"options": replace(OPTIONS, sensor="eye")}, "'eye'"),
        ({"options": replace(OPTIONS, without=("rain",))}, "'rain'"),
    ):
        given = {"scene": HEAP, "out": tmp_path / "out", "count": 2, "options": OPTIONS} | wrong
        with pytest.raises(DepthbaError, match=text):
            generate_many(**given)  # type: ignore[arg-type]
    (tmp_path / "own.xml").write_text("<mujoco/>")
    with contextlib.chdir(tmp_path), pytest.raises(OptionError, match="absolute path"):
        generate_many("own.xml", "out", 2, scheduler="tcp://127.0.0.1:1")
    assert list((tmp_path / "out").glob("*")) == []


def test_a_cluster_makes_the_same_bytes_and_outlives_a_killed_worker(
    expected: Tree, tmp_path: Path
) -> None:
    pytest.importorskip("distributed", reason="needs depthba[distributed]")
    out = tmp_path / "out"
    with contextlib.ExitStack() as stack:
        address = stack.enter_context(dask_scheduler(tmp_path))
        assert address.startswith("tcp://127.0.0.1:")
        words = dask_worker(address, tmp_path / "dask")
        doomed, _ = [stack.enter_context(command(*words)) for _ in range(2)]
        process = stack.enter_context(command(*batch(out, "--scheduler", address)))
        until(lambda: committed(out) > 3, "frames")
        doomed.kill()
        assert process.wait() == 0
    assert tree(out) == expected
