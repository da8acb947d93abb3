"""Review: which recordings it opens, and that nothing of it can be reached from outside."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from rerun.chunk import RrdReader

from depthba import se3
from depthba.dataset import Dataset
from depthba.errors import MissingPackage, RunError
from depthba.options import Options
from depthba.result import Result
from depthba.trajectory import write_tum
from eval import review
from eval.compare import compare_runs
from eval.evaluate import evaluate
from eval.rebuild import rebuild
from eval.recording import Recorder
from eval.recordings_table import find_recordings, read_rows
from eval.verbs import review as verb
from tests.eval.conftest import listeners, write_scene


def test_the_newest_run_opens_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunError, match="no run there yet"):
        review.recordings([])
    run = tmp_path / "logs" / "demo" / "default"
    run.mkdir(parents=True)
    (tmp_path / "logs" / "latest").symlink_to("demo/default")
    with pytest.raises(RunError, match=r"result\.json: missing"):
        review.recordings([])
    (run / "run.rrd").write_bytes(b"")
    assert review.recordings([]) == [run / "run.rrd"]
    assert review.recordings([run, run / "run.rrd"]) == 2 * [run / "run.rrd"]
    with pytest.raises(RunError, match="no such run"):
        review.recordings([tmp_path / "nothing"])


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(review, "SOFTWARE_DRIVERS", (str(tmp_path),))
    with pytest.raises(MissingPackage, match="mesa-vulkan-drivers"):
        review.screenshot([], tmp_path / "shot.png")
    (tmp_path / "lvp_icd.x86_64.json").write_text("{}")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingPackage, match="apt-get install xvfb"):
        review.screenshot([], tmp_path / "shot.png")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if sys.platform.startswith("linux"):
        with pytest.raises(RunError, match="no screen here"):
            review.show([])
    both = verb.Arguments(web=True, screenshot=tmp_path / "shot.png")
    assert verb.run(both) == 2


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, dataset: Dataset, result: Result) -> Path:
    run = tmp_path_factory.mktemp("run")
    recorder = Recorder(run / "run.rrd", dataset, Options())
    recorder.finish(result)
    return run


def column(path: Path, content: str, name: str) -> list[Any]:
    batches = [c.to_record_batch() for c in RrdReader(path).stream().filter(content=[content])]
    return [v for b in batches if name in b.schema.names for v in b.column(name).to_pylist()]


def test_a_run_without_a_recording_gets_one(run: Path, dataset: Dataset, result: Result) -> None:
    """As the archive tells it: start, result, scalars of the steps, certainty, figures."""
    metrics = {m.name: m.value for m in evaluate(run)}
    assert review.recordings([run]) == [run / "run.rrd"]
    file = run / "run.rrd"
    when = column(file, "/cam/2", "iteration")
    end = len(result.history) + 1
    where = [t[0] for t in column(file, "/cam/2", "Transform3D:translation")]
    at = dict(zip(when, where, strict=True))
    assert sorted(at) == [0, end]
    assert_allclose(at[0], result.T_world_camera_start[2, :3, 3], atol=1e-6)
    assert_allclose(at[end], result.T_world_camera[2, :3, 3], atol=1e-6)
    sigmas = [v[0] for v in column(file, "/curves/sigma/sigma", "Scalars:scalars")]
    assert_allclose(sigmas, [1e3 * i.sigma for i in result.history])
    assert column(file, "/certainty/open", "Arrows3D:vectors")
    row = read_rows([file])[0]
    assert (row.run["dataset"], row.run["status"], row.run["iterations"]) == ("waves", "weak", 4)
    assert_allclose(row.metrics["translation_mae"], metrics["translation_mae"])
    before = file.stat().st_mtime_ns
    assert review.recordings([run]) == [file] and file.stat().st_mtime_ns == before
    review.recordings([run], rebuild=True)
    assert file.stat().st_mtime_ns > before


def test_what_cannot_be_rebuilt_leaves_nothing(
    run: Path, tmp_path: Path, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = write_scene(tmp_path / "other", 3)
    with pytest.raises(RunError, match="its 6 frames are not the 3 of"):
        rebuild(run, other.path)
    told = json.loads((run / "result.json").read_text())
    told["dataset"]["path"] = str(tmp_path / "gone")
    (run / "result.json").write_text(json.dumps(told))
    with pytest.raises(RunError, match="say where with --dataset"):
        rebuild(run)
    assert rebuild(run, dataset.path).is_file()
    (run / "run.rrd").unlink()
    (run / "map.npz").write_bytes(b"PK")
    with pytest.raises(RunError, match="not a whole run folder"):
        rebuild(run, dataset.path)
    assert not list(run.glob("*.rrd")) and not list(run.glob(".*"))


@pytest.fixture
def worse(run: Path, dataset: Dataset) -> Path:
    """A folder as another method leaves it: poses and result.json alone."""
    folder = run.parent / "other-method"
    folder.mkdir()
    told = json.loads((run / "result.json").read_text())
    kept = ("format", "version", "name", "status", "dataset")
    (folder / "result.json").write_text(json.dumps({k: told[k] for k in kept}))
    half = se3.retract(
        dataset.T_world_camera_true,
        0.5 * se3.difference(dataset.T_world_camera_measured, dataset.T_world_camera_true),
    )
    write_tum(folder / "poses.txt", dataset.stamps, half, "half way")
    return folder


def test_runs_side_by_side(run: Path, worse: Path, dataset: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "compare.rrd"
    compare_runs([worse, run], file)
    # run 0 is the start
    for k in range(3):
        shown = column(file, f"/run/{k}/cam/1/points", "Points3D:positions")[0]
        assert len(shown) > 1000
        assert column(file, f"/run/{k}/spread", "EncodedImage:blob")
        assert column(file, f"/run/{k}/picture", "EncodedImage:blob")
    place = np.array(column(file, "/run/2/cam/3", "Transform3D:translation")[0][0])
    assert dataset.T_world_camera_true is not None
    assert_allclose(place, dataset.T_world_camera_true[3, :3, 3], atol=1e-3)
    page = column(file, "/figures", "TextDocument:text")[0][0]
    lines = [[c.strip() for c in row.split("|")[1:-1]] for row in page.strip().splitlines()]
    assert [row[0] for row in lines[2:]] == ["start poses", "other-method", "run"]
    errors = [float(row[1].strip("*").split()[0]) for row in lines[2:]]
    assert_allclose(errors[1], 0.5 * errors[0], rtol=0.02)
    assert errors[2] < 0.2 and lines[4][1].startswith("**") and not lines[3][1].startswith("**")
    assert len(RrdReader(file).blueprints()) == 1


def test_only_runs_of_one_dataset_compare(
    run: Path, worse: Path, dataset: Dataset, tmp_path: Path
) -> None:
    file = tmp_path / "compare.rrd"
    other = write_scene(tmp_path / "moved" / "waves", 5)
    told = json.loads((worse / "result.json").read_text())
    told["dataset"]["path"] = str(other.path)
    (worse / "result.json").write_text(json.dumps(told))
    with pytest.raises(RunError, match="other-method: is of the dataset waves"):
        compare_runs([run, worse], file)
    with pytest.raises(RunError, match="1 run given, expected two or more"):
        compare_runs([run], file)
    # the same frames in another place are the same dataset
    copy = Path(shutil.copytree(dataset.path, tmp_path / "copy"))
    told["dataset"]["path"] = str(copy)
    (worse / "result.json").write_text(json.dumps(told))
    compare_runs([run, worse], file)
    assert file.is_file()


def test_the_table_of_many_recordings(
    recorded: Path, tmp_path: Path, result: Result, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (recorded / "run.rrd").read_bytes()
    for name, data in {"a": whole, "b": whole[:-200_000], "c": b"no recording"}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.rrd").write_bytes(data)
    assert verb.run(verb.Arguments(runs=(tmp_path,), table=True, json=True)) == 0
    told = json.loads(capsys.readouterr().out)["recordings"]
    assert [Path(t["recording"]).parent.name for t in told] == ["a", "b", "c"]
    assert told[0]["problem"] is None
    assert told[0]["run"]["preset"] == "default" and told[0]["run"]["seed"] == 5
    # never evaluated: the last of the curve stands for the figure
    assert_allclose(told[0]["metrics"]["translation_mae"], 1e-4, rtol=0.5)
    assert "Not an RRD file" in told[2]["problem"] and told[1]["problem"]
    assert verb.run(verb.Arguments(runs=(tmp_path,), table=True)) == 0
    shown = capsys.readouterr().out
    assert "waves" in shown and "Not an RRD file" in shown
    with pytest.raises(RunError, match="no such run folder"):
        find_recordings([tmp_path / "nothing"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunError, match="no recording"):
        find_recordings([tmp_path / "empty"])
    assert verb.run(verb.Arguments(runs=(tmp_path,), table=True, web=True)) == 2
    assert verb.run(verb.Arguments(runs=(tmp_path,), table=True, compare=True)) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc/net/tcp")
def test_the_web_viewer_listens_on_this_machine_alone(recorded: Path) -> None:
    port = review.free_port()
    command = [sys.executable, "-c", "import sys; from depthba.cli import main; sys.exit(main())"]
    command += ["review", str(recorded), "--web", "--port", str(port)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while True:
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5) as page:
                    assert page.status == 200
                break
            except OSError:
                assert process.poll() is None and time.monotonic() < deadline
                time.sleep(0.1)
        assert listeners(port) == [f"0100007F:{port:04X}"]
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=20)
    with pytest.raises(OSError), socket.create_connection(("127.0.0.1", port), timeout=5):
        pass  # the viewer went with it


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="Xvfb is not installed")
def test_a_screenshot_without_a_screen(recorded: Path, tmp_path: Path) -> None:
    picture = tmp_path / "new" / "shot.png"
    assert verb.run(verb.Arguments(runs=(recorded,), screenshot=picture)) == 0
    image = cv2.imread(os.fspath(picture))
    assert image is not None and image.shape[1] >= review.WINDOW[0]
    assert image.std() > 20
