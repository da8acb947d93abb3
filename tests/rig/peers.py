"""Simulated devices as processes of their own, and ends of a line where nobody answers."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from rig.errors import RigError

ROOT = Path(__file__).parents[2]
LONGEST = float(os.environ.get("FAULT_SECONDS", "60"))
"""By when a fault has to have ended, s. What takes longer hangs; `tests/benchmarks/test_faults.py`
asks for the 5 s that are aimed at, which a machine shared with others may miss."""


@contextmanager
def peer(module: str, *words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run ``python -m module`` until the block ends; yield it and where it listens."""
    process = subprocess.Popen(
        [sys.executable, "-m", module, *words],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert select.select([process.stdout], [], [], 60)[0], f"{module} does not start"
        line = process.stdout.readline()
        assert line.startswith("listening on "), line
        yield process, line.split()[-1]
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def loopback() -> str:
    """Return a loopback address of this process's own."""
    pid = os.getpid()
    return f"127.{1 + (pid >> 14 & 0x7F)}.{pid >> 7 & 0x7F}.{2 + (pid & 0x7F)}"


@contextmanager
def silent_listener() -> Iterator[tuple[str, int]]:
    """Listen, let clients in, say nothing."""
    with socket.create_server((loopback(), 0)) as server:
        yield server.getsockname()


@contextmanager
def unreachable() -> Iterator[tuple[str, int]]:
    """Yield an address that answers no attempt to connect: its queue is full."""
    with ExitStack() as stack:
        server = stack.enter_context(socket.socket())
        server.bind((loopback(), 0))
        server.listen(0)
        for _ in range(3):
            client = stack.enter_context(socket.socket())
            client.setblocking(False)
            client.connect_ex(server.getsockname())
        yield server.getsockname()


@contextmanager
def ends_in_time() -> Iterator[None]:
    """See that a fault has ended by then."""
    began = time.monotonic()
    yield
    assert time.monotonic() - began < LONGEST


def one_line(error: pytest.ExceptionInfo[RigError]) -> str:
    """The message, which is one line and says what was expected."""
    text = str(error.value)
    assert "\n" not in text and "expected" in text
    return text
