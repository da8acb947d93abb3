"""Review: which recordings it opens, and that nothing of it can be reached from outside."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import cv2
import pytest

from depthba.dataset import Dataset
from depthba.errors import MissingPackage, RunError
from depthba.options import Options
from depthba.result import Result
from eval import review
from eval.recording import Recorder
from eval.verbs import review as verb


def test_the_newest_run_opens_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunError, match="no run there yet"):
        review.recordings([])
    run = tmp_path / "logs" / "demo" / "default"
    run.mkdir(parents=True)
    (tmp_path / "logs" / "latest").symlink_to("demo/default")
    with pytest.raises(RunError, match="no recording"):
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
        listeners = [
            row.split()[1]
            for table in ("tcp", "tcp6")
            for row in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
            if row.split()[3] == "0A" and row.split()[1].endswith(f":{port:04X}")
        ]
        assert listeners == [f"0100007F:{port:04X}"]
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
