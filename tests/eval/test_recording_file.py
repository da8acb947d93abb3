"""A recording on a disk that takes no more, for which Rerun's own writer would wait forever."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from eval.recording_file import RecordingFile

FULL = """
import resource, sys
from pathlib import Path
import numpy as np, rerun as rr
from eval.recording_file import RecordingFile
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
file = RecordingFile(Path(sys.argv[1]))
for i in range(40):
    file.stream.log(f"points/{i}", rr.Points3D(np.random.rand(20_000, 3)))
try:
    getattr(file, sys.argv[2])()
except OSError as error:
    print(error)
"""
"""Writes 10 MB where files may have one."""


@pytest.mark.parametrize("end", ["finish", "discard", "__hash__"])
def test_a_disk_that_takes_no_more_is_named_and_nothing_hangs(tmp_path: Path, end: str) -> None:
    """However the recording ends; with ``__hash__`` it does not, and the program does."""
    path = tmp_path / "run.rrd"
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(path), end], capture_output=True, text=True, timeout=60,
        cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not path.exists()
    if end == "finish":
        assert "File too large" in done.stdout and "run.rrd" in done.stdout
    if end != "__hash__":
        assert list(tmp_path.iterdir()) == []


def test_a_recording_is_whole_once_finished(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    file = RecordingFile(path)
    points = np.random.default_rng(0).normal(size=(200_000, 3)).astype(np.float32)
    file.stream.log("points", rr.Points3D(points), static=True)
    assert not path.exists()
    file.finish()
    assert [p.name for p in tmp_path.iterdir()] == ["run.rrd"]
    (entry,) = RrdReader(path).recordings()
    assert entry.application_id == "depthba"
    chunks = [c for c in RrdReader(path).stream().to_chunks() if c.entity_path == "/points"]
    assert len(chunks) == 1


def test_a_process_forked_meanwhile_keeps_no_recording_open(tmp_path: Path) -> None:
    file = RecordingFile(tmp_path / "run.rrd")
    # as a fork, it holds all that is open here
    other = subprocess.Popen(["sleep", "60"], pass_fds=_open_files())
    try:
        file.stream.log("points", rr.Points3D(np.ones((10, 3))), static=True)
        file.finish()
    finally:
        other.kill()
        other.wait()
    assert len(list(RrdReader(tmp_path / "run.rrd").recordings())) == 1


def _open_files() -> list[int]:
    """Return the numbers of what is open, those of this look left out."""
    found = []
    for name in os.listdir("/dev/fd"):
        with contextlib.suppress(OSError):
            os.fstat(int(name))
            found.append(int(name))
    return found


def test_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        RecordingFile(tmp_path / "nowhere" / "run.rrd")
