"""Real processes for tests: commands of which nothing is left behind, and a Dask scheduler."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOOPBACK = ["--host", "127.0.0.1", "--no-dashboard"]
"""Words of `dask scheduler` and `dask worker`."""


@contextlib.contextmanager
def command(*words: str, stderr: int = subprocess.DEVNULL) -> Iterator[subprocess.Popen[str]]:
    """Run a Python module in a group of its own, of which nothing is left behind."""
    process = subprocess.Popen(
        [sys.executable, "-m", *words],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        start_new_session=True,
        # whoever runs the tests in the background may have switched the signal off
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def until(true: Callable[[], bool], what: str, seconds: float = 120.0) -> None:
    """Wait for a condition, and fail where it does not come."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, f"{what}: not within {seconds} s"
        time.sleep(0.005)


@contextlib.contextmanager
def dask_scheduler(folder: Path) -> Iterator[str]:
    """Run a scheduler and give its address; its file is in `folder`."""
    about = folder / "scheduler.json"

    def written() -> bool:
        # Dask opens the file first and fills it then
        return about.exists() and about.read_text().rstrip().endswith("}")

    with command("dask", "scheduler", *LOOPBACK, "--port", "0", "--scheduler-file", str(about)):
        until(written, "scheduler")
        yield json.loads(about.read_text())["address"]


def dask_worker(address: str, folder: Path) -> list[str]:
    """Return the words of a worker's command, which keeps its files in `folder`."""
    words = ["dask", "worker", address, *LOOPBACK, "--nthreads", "1", "--no-nanny"]
    return [*words, "--local-directory", str(folder)]
