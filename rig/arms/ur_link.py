"""The parent's end of the pipe to the process that owns the client library."""

from __future__ import annotations

import collections
import contextlib
import itertools
import json
import os
import queue
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import IO, Any

from rig.errors import ArmError

_PARTING = 1.2
"""For a child to brake the arm, end the script and hang up, s."""


class Refused(ArmError):
    """The library threw; the link goes on."""


class Lost(ArmError):
    """The child is gone, or did not answer and was ended."""


class Link:
    """One child process. Safe to use from several threads; each request has a deadline."""

    def __init__(self, host: str) -> None:
        """Start the child; it imports the library, nothing more. `host` is for the messages."""
        self._host = host
        environment = dict(os.environ)
        root = str(Path(__file__).parents[2])
        paths = [root, *filter(None, [environment.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
        self._child = subprocess.Popen(
            [sys.executable, "-m", "rig.arms.ur_child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        self._answers: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._said: collections.deque[str] = collections.deque(maxlen=5)
        self._lock = threading.Lock()
        self._numbers = itertools.count()
        assert self._child.stdout is not None and self._child.stderr is not None
        for target, stream in ((self._hear, self._child.stdout), (self._note, self._child.stderr)):
            threading.Thread(target=target, args=(stream,), daemon=True).start()

    @property
    def pid(self) -> int:
        """Of the child."""
        return self._child.pid

    def ask(self, do: str, deadline: float, **arguments: Any) -> Any:
        """What the child answers to a request within `deadline` s.

        Refused where the library threw; Lost where there is no answer: the child is ended then.
        """
        with self._lock:
            number = next(self._numbers)
            # The child ends itself a little later, should nobody be here any more to do it.
            limit = deadline + 2.0
            request = {"number": number, "do": do, "limit": limit, "arguments": arguments}
            end = time.monotonic() + deadline
            try:
                assert self._child.stdin is not None
                self._child.stdin.write(json.dumps(request) + "\n")
                self._child.stdin.flush()
            except (OSError, ValueError):
                raise self._lost("its client ended") from None
            while True:
                try:
                    answer = self._answers.get(timeout=max(end - time.monotonic(), 0.0))
                except queue.Empty:
                    self._end()
                    raise self._lost(f"no answer to {do!r} within {deadline:g} s") from None
                if answer is None:
                    self._answers.put(None)
                    raise self._lost("its client ended")
                if answer["number"] == number:
                    break
        if "error" in answer:
            raise Refused(f"{self._host}: {answer['error']}")
        return answer["value"]

    def close(self) -> None:
        """Let the child brake and hang up, then end it; at once where it hangs."""
        with self._lock:
            if self._child.stdin is not None:
                # It hangs, or is gone already: it is ended in any case.
                with contextlib.suppress(OSError, ValueError, subprocess.TimeoutExpired):
                    self._child.stdin.close()
                    self._child.wait(_PARTING)
            self._end()

    def _end(self) -> None:
        if self._child.poll() is None:
            self._child.kill()
        self._child.wait()

    def _lost(self, what: str) -> Lost:
        words = f" ({self._said[-1]})" if self._said else ""
        return Lost(f"{self._host}: {what}{words}; expected a controller that keeps answering")

    def _hear(self, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                self._answers.put(json.loads(line))
        self._answers.put(None)

    def _note(self, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                if line.strip():
                    self._said.append(" ".join(line.split()))
