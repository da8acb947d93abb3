"""Live views: what reaches a viewer on this machine, and what is recorded where it goes away."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rerun.chunk import RrdReader

from depthba.dataset import Dataset
from depthba.errors import RunError
from depthba.options import Options
from depthba.result import Result
from depthba.verbs import register as verb
from eval import live, review
from eval.live import CaptureLog
from eval.recording import Recorder
from tests.eval.conftest import listeners, write_scene

PATIENCE = 30.0
"""Seconds that a viewer has to save what it was sent."""


class SavingViewer:
    """A real viewer process without a window, that saves what it is sent."""

    def __init__(self, file: Path) -> None:
        port = review.free_port()
        self.file = file
        self.address = f"rerun+http://127.0.0.1:{port}/proxy"
        command = [str(review.viewer()), "--bind", "127.0.0.1", "--port", str(port)]
        environment = {**os.environ, "RUST_LOG": "error"}
        self.process = subprocess.Popen([*command, "--save", str(file)], env=environment)
        live.await_port(self.process, port)

    def end(self, entities_due: set[str] | None = None) -> RrdReader:
        """End it, once it has saved the entities due: it writes some time after it is sent."""
        if entities_due is not None:
            deadline, before = time.monotonic() + PATIENCE, -1
            while time.monotonic() < deadline:
                now = self.file.stat().st_size
                if now == before and self._saved() >= entities_due:
                    break
                before = now
                time.sleep(0.5)
        review.end(self.process)
        return RrdReader(self.file)

    def _saved(self) -> set[str]:
        try:
            return entities(RrdReader(self.file))
        except (ValueError, RuntimeError):  # caught in the middle of a write
            return set()


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[SavingViewer]:
    started = SavingViewer(tmp_path / "seen.rrd")
    yield started
    review.end(started.process)


def entities(reader: RrdReader) -> set[str]:
    return {str(chunk.entity_path) for chunk in reader.stream()}


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_registration_is_seen_while_it_runs(
    viewer: SavingViewer, tmp_path: Path, dataset: Dataset, result: Result
) -> None:
    recorder = Recorder(tmp_path / "run.rrd", dataset, Options(), viewer=viewer.address)
    for iteration in result.history:
        recorder(iteration)
    recorder.finish(result)
    kept = RrdReader(tmp_path / "run.rrd")
    seen = viewer.end(entities(kept))
    assert entities(seen) == entities(kept)
    assert len(seen.blueprints()) == 2  # one while it runs, one of the finished run


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_viewer_that_is_closed_spoils_nothing(
    viewer: SavingViewer, tmp_path: Path, dataset: Dataset, result: Result
) -> None:
    recorder = Recorder(tmp_path / "run.rrd", dataset, Options(), viewer=viewer.address)
    recorder(result.history[0])
    viewer.end()
    for iteration in result.history[1:]:
        recorder(iteration)
    recorder.finish(result)
    batches = [
        c.to_record_batch()
        for c in RrdReader(tmp_path / "run.rrd").stream().filter(content=["/cam/2"])
    ]
    when = [k for b in batches for k in b.column("iteration").to_pylist()]
    assert sorted(when) == list(range(len(result.history) + 2))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc/net/tcp")
def test_a_live_page_is_for_this_machine_alone() -> None:
    view = live.Viewer.open(web=True)
    try:
        assert view.page is not None
        with urllib.request.urlopen(view.page.partition("?")[0], timeout=30) as page:
            assert page.status == 200
        ports = [int(re.findall(r":(\d+)", url)[0]) for url in (view.page, view.address)]
        assert ports[0] != ports[1]
        for port in ports:
            assert listeners(port) == [f"0100007F:{port:04X}"]
    finally:
        view.close()
    assert not [where for port in ports for where in listeners(port)]


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_capture_is_seen_as_it_goes(viewer: SavingViewer, tmp_path: Path) -> None:
    dataset = write_scene(tmp_path / "scene", 3, rgb=True)
    log = CaptureLog(dataset.sensor, "session", tmp_path / "run.rrd", viewer.address)
    for frame in dataset:
        half = frame.T_world_camera.copy()
        half[0, 3] -= 0.1
        log.moved(half, frame.stamp - 0.5)
        log.add(frame)
    with pytest.raises(RunError, match="2 poses for 3 frames"):
        log.poses(dataset.T_world_camera_measured[:2])
    assert dataset.T_world_camera_true is not None
    log.poses(dataset.T_world_camera_true)
    assert not (tmp_path / "run.rrd").exists()  # not before it is whole
    log.finish()
    kept = RrdReader(tmp_path / "run.rrd")
    for reader in (viewer.end(entities(kept)), kept):
        assert entities(reader) >= {
            *(f"/cam/{i}{part}" for i in range(3) for part in ("", "/points", "/image")),
            "/path/way",
            "/path/here",
            "/last/rgb",
            "/last/depth",
            "/figures",
        }
        moved = [
            c.to_record_batch().column("Transform3D:translation").to_pylist()
            for c in reader.stream().filter(content=["/cam/2"])
        ]
        last = [row[0] for rows in moved for row in rows][-1]
        assert_allclose(last, dataset.T_world_camera_true[2, :3, 3], atol=1e-6)
        ways = [
            row[0]
            for c in reader.stream().filter(content=["/path/way"])
            for row in c.to_record_batch().column("LineStrips3D:strips").to_pylist()
        ]
        assert len(max(ways, key=len)) == 6  # a stop before each frame, and each frame
        assert len(reader.blueprints()) == 1


def test_a_capture_log_needs_somewhere_to_go(dataset: Dataset, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="neither a recording nor a viewer"):
        CaptureLog(dataset.sensor, "session")
    log = CaptureLog(dataset.sensor, "session", tmp_path / "run.rrd")
    log.moved(np.eye(4), 0.0)
    log.discard()
    assert list(tmp_path.iterdir()) == []


def test_without_a_screen_one_line_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with (
        pytest.raises(RunError, match=r"no screen here.*use --live --web"),
        live.opened(),
    ):
        raise AssertionError("opened a window without a screen")
    assert verb.run(verb.Arguments(Path("nothing"), web=True)) == 2
