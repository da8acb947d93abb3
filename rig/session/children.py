"""Simulated rigs as processes of their own, each on a loopback address of its own."""

from __future__ import annotations

import contextlib
import os
import queue
import random
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, TypeVar

T = TypeVar("T")

START = 90.0
"""For a simulated rig to be ready, s."""


def address() -> str:
    """A loopback address that hardly any other process takes."""
    rng = random.Random(os.getpid() ^ time.time_ns())
    return f"127.{rng.randint(16, 254)}.{rng.randint(0, 254)}.{rng.randint(2, 254)}"


class Child:
    """A child that says on stdout that it is ready. It ends with the block."""

    def __init__(self, words: list[str]) -> None:
        root = str(Path(__file__).parents[2])
        environment = dict(os.environ)
        paths = [root, *filter(None, [environment.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        # Ctrl-C at the terminal is for the session: the robot must be there to be braked.
        self._child = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=environment,
            start_new_session=True,
        )
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        threading.Thread(target=self._hear, daemon=True).start()

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *error: object) -> None:
        self._child.terminate()
        try:
            self._child.wait(2.0)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._errors.close()

    def said(self, timeout: float, read: Callable[[str], T | None]) -> T | None:
        """Wait until something can be read from what it has said; None: it ended, or took too long.

        Args:
            timeout: s.
            read: makes something of all that was said so far, or None where there is more to come.
        """
        text, deadline = "", time.monotonic() + timeout
        while True:
            try:
                line = self._lines.get(timeout=max(deadline - time.monotonic(), 0.0))
            except queue.Empty:
                return None
            if line is None:
                return None
            text += line
            if (found := read(text)) is not None:
                return found

    def last_words(self) -> str:
        """The last line that it wrote on stderr."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(1.0)
        self._errors.seek(0)
        lines = self._errors.read().decode("utf-8", "replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "")

    def _hear(self) -> None:
        assert self._child.stdout is not None
        with self._child.stdout as stream:
            for line in stream:
                self._lines.put(line)
        self._lines.put(None)
