"""The benchmark with real processes: every end of a method is a row, and what is done stays."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from depthba import cli
from depthba.dataset import Dataset
from depthba.errors import DepthbaError, OptionError
from depthba.trajectory import read_tum
from eval.benchmark import outcome, plan, report, runner, summary, tables
from eval.benchmark.outcome import Outcome
from eval.benchmark.plan import Job
from eval.benchmark.warming import FRAMES, small_dataset
from eval.metrics import Metric

ROOT = Path(__file__).parents[2]
ODD = "tests.eval.odd_methods:"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_dataset(tmp_path_factory.mktemp("data") / "waves").path


def job(
    dataset: Path, out: Path, *methods: str, seconds: float = 120.0, memory: float = 4e9
) -> Job:
    (case,) = plan.given_cases([dataset])
    names = tuple(m if m == "initial" else ODD + m for m in methods)
    return Job(case, names, out, 1, seconds, memory)


def run(*jobs: Job) -> dict[str, Outcome]:
    found = runner.run(jobs, 1, None, lambda *_: None)
    return {o.method.removeprefix(ODD): o for o in found}


def test_every_end_is_a_row(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    ballast = np.ones(100_000_000)  # memory of whoever runs a method is not the method's
    found = run(
        job(dataset, tmp_path, "initial", "Knows", "Refuses", "Raises", "Dies", "Diverges"),
    )
    assert {m: o.status for m, o in found.items()} == {
        "initial": "done",
        "Knows": "done",
        "Refuses": "failed",
        "Raises": "crashed",
        "Dies": "crashed",
        "Diverges": "failed",
    }
    assert found["Refuses"].reason == "frames 1 and 2 share nothing"
    assert re.fullmatch(r"KeyError: 'nothing' \(odd_methods.py:\d+\)", found["Raises"].reason)
    assert "signal 9" in found["Dies"].reason
    assert "not finite" in found["Diverges"].reason
    assert ballast.nbytes == 8e8
    knows = found["Knows"]
    assert knows.value("translation_mae_x") == pytest.approx(0.001, rel=1e-6)
    assert knows.value("rotation_mae") == pytest.approx(0.0, abs=1e-9)
    assert knows.total == 1.5 and knows.iterations == 3
    assert knows.memory is not None and 3e7 < knows.memory < 6e8
    folder = tmp_path / dataset.name / f"{ODD}Knows"
    poses = read_tum(folder / outcome.POSES)[1]
    assert poses.shape == (FRAMES, 4, 4)
    assert not list(tmp_path.rglob("request.json"))


def test_limits_stop_a_method_and_are_lifted_by_larger_ones(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    slow = job(dataset, tmp_path, "Sleeps", seconds=1.0)
    assert run(slow)["Sleeps"].status == "time"
    assert not runner.needed(slow, ODD + "Sleeps")
    assert runner.needed(replace(slow, seconds=2.0), ODD + "Sleeps")
    large = job(dataset, tmp_path, "Hoards", memory=6e8)
    stopped = run(large)["Hoards"]
    assert stopped.status == "memory" and "0.6 GB" in stopped.reason
    left = [" ".join(p.cmdline()) for p in psutil.Process().children(recursive=True)]
    assert not [words for words in left if "eval.benchmark.child" in words]


def test_what_is_done_is_not_run_again(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    work = job(dataset, tmp_path, "initial", "Knows", "Refuses")
    first = run(work)
    files = {m: work.folder(m) / outcome.FILE for m in work.methods}
    stamps = {m: f.stat().st_mtime_ns for m, f in files.items()}
    files[ODD + "Knows"].write_text("{", encoding="utf-8")  # as a crash of the disk leaves it
    again = run(work)
    assert {m: replace(o, memory=None) for m, o in again.items()} == {
        m: replace(o, memory=None) for m, o in first.items()
    }
    changed = {m for m, f in files.items() if f.stat().st_mtime_ns != stamps[m]}
    assert changed == {ODD + "Knows"}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_what_a_full_disk_ends_is_no_result(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    filled = run(job(dataset, tmp_path, "Fills"))["Fills"]
    assert filled.status == "done", filled.reason
    work = job(dataset, tmp_path, "Knows", "FullForGood")
    with pytest.raises(DepthbaError, match="FullForGood: No space left on device"):
        run(work)
    assert not runner.needed(work, ODD + "Knows") and runner.needed(work, ODD + "FullForGood")
    assert not list(work.folder(ODD + "FullForGood").iterdir())


def test_a_killed_benchmark_goes_on_and_leaves_no_process(dataset: Path, tmp_path: Path) -> None:
    command = [
        sys.executable, "-m", "depthba", "benchmark", "--datasets", str(dataset),
        "--methods", f"initial,{ODD}Sleeps", "--out", str(tmp_path), "--workers", "1",
    ]  # fmt: skip
    process = subprocess.Popen(
        command, cwd=ROOT, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )
    request = tmp_path / dataset.name / f"{ODD}Sleeps" / "request.json"
    deadline = time.monotonic() + 100
    while not request.is_file() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert request.is_file()
    family = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGKILL)
    process.wait()
    _, alive = psutil.wait_procs(family, timeout=30)
    assert not alive
    before = (tmp_path / dataset.name / "initial" / outcome.FILE).stat().st_mtime_ns
    command[command.index(f"initial,{ODD}Sleeps")] = f"initial,{ODD}Knows"
    done = subprocess.run(
        [*command, "--json"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    told = json.loads(done.stdout)
    assert {o["method"]: o["status"] for o in told["outcomes"]} == {
        "initial": "done", f"{ODD}Knows": "done",
    }  # fmt: skip
    assert (tmp_path / dataset.name / "initial" / outcome.FILE).stat().st_mtime_ns == before
    assert told == json.loads((tmp_path / "results.json").read_text())
    page = (tmp_path / "report.html").read_text()
    assert "waves" in page and 'src="data:image/png' in page
    assert not re.search(r"""(src|href)=["'](?!data:)""", page)
    assert os.path.getsize(tmp_path / "report.html") < 2e6
    tex = (tmp_path / "tables.tex").read_text()
    assert tex.count("\\begin{tabular}") == tex.count("\\end{tabular}") == 3


def made(method: str, seed: int, error: float | None, group: str = "lab-1") -> Outcome:
    metrics = () if error is None else (Metric("translation_mae", "m", "lower", error),)
    status = "failed" if error is None else "done"
    return Outcome("k", f"{group}-{seed}", group, seed, method, status, metrics=metrics)


def test_failures_count_as_infinite_and_initial_is_not_ranked() -> None:
    outcomes = [
        *(made("initial", s, 1e-6) for s in range(3)),
        made("kiss", 0, 1e-4), made("kiss", 1, None), made("kiss", 2, None),
        made("teaser", 0, 4e-3), made("teaser", 1, 2e-3), made("teaser", 2, 9e-3),
        made("depthba", 0, 3e-3), made("depthba", 1, 5e-3), made("depthba", 2, None),
    ]  # fmt: skip
    row = summary.row(outcomes, "lab-1", "translation_mae")
    assert np.isinf(row.cells["kiss"].median)
    assert row.cells["teaser"].median == 4e-3
    assert (row.cells["teaser"].low, row.cells["teaser"].high) == (2e-3, 9e-3)
    assert row.cells["depthba"].median == 5e-3 and row.cells["depthba"].done == 2
    assert (row.best, row.second) == ("teaser", "depthba")
    (first,) = [t for t in tables.usual_tables(outcomes, True) if t.title.startswith("Poses")]
    text = tables.markdown(first)
    assert "| **4.00** |" in text and "_5.00 (2/3)_" in text and "failed" in text
    assert "paper" in text and "14.1" in text  # the paper's TEASER on its scene 1, mm
    assert "\\textbf{4.00}" in tables.latex(first, "x")
    lines = report.verdict(outcomes, True)
    assert lines[0] == "poses, laboratory scenes: depthba is first in 0 of 1 rows"
    assert "TEASER is first with 4.00, depthba 5.00 (3.00 to 5.00)" in lines[1]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--methods", "nonsense", "--datasets", "."], "'nonsense': unknown; choose from: initial"),
        (["--datasets", "nowhere"], "nowhere: no dataset there"),
        ([], "nothing to run"),
        (["--scenes", "lab-1", "--seeds", "0"], "--seeds 0"),
        (["--scenes", "lab-9"], "lab-9: unknown; choose from"),
        (["--study", "colour"], "colour: unknown; choose from: start"),
        (["--quick", "--scenes", "lab-1"], "--quick: expected --paper"),
        (["--scenes", "lab-1", "--workers", "0"], "--workers 0"),
    ],
)
def test_wrong_words_are_one_clear_line(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert cli.main(["benchmark", "--out", str(out), *words]) == 1
    error = capsys.readouterr().err.strip()
    assert said in error and "\n" not in error
    assert not out.exists()


def test_datasets_of_one_name_are_kept_apart(dataset: Path, tmp_path: Path) -> None:
    other = small_dataset(tmp_path / dataset.name).path
    names = [case.name for case in plan.given_cases([dataset, other, dataset])]
    assert len(set(names)) == 3
    with pytest.raises(OptionError, match="unknown"):
        plan.methods_of("teaser,nope")
    assert plan.methods_of("depthba,initial") == ("initial", "depthba")


def test_studies_vary_one_thing(tmp_path: Path) -> None:
    cases = plan.study_cases("noise", "industrial-5", 2, tmp_path)
    assert len(cases) == 2 * len(plan.STUDIES["noise"])
    assert len({c.name for c in cases}) == len({c.path for c in cases}) == len(cases)
    factors = {c.options.depth_noise for c in cases if c.options}
    assert factors == set(plan.STUDIES["noise"])
    frames = plan.study_cases("frames", "industrial-5", 1, tmp_path)
    assert len({c.path for c in frames}) == 1 and {c.first for c in frames} >= {6, 21}


def test_subset_keeps_what_belongs_to_its_frames(dataset: Path) -> None:
    whole = Dataset.open(dataset)
    part = whole.subset([2, 0])
    assert part.ids == (whole.ids[0], whole.ids[2])
    assert part.T_world_camera_true is not None and len(part.T_world_camera_true) == 2
    assert np.array_equal(part.T_world_camera_measured, whole.T_world_camera_measured[[0, 2]])
