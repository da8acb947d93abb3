"""Any camera in a process of its own, so that what hangs or crashes there ends nothing here."""

from __future__ import annotations

import collections
import contextlib
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from depthba.errors import MissingPackage
from rig.cameras.camera import CameraInfo, Capture
from rig.errors import CameraError, CameraTimeout

_PARTING = 3.0
"""For the process to close the camera and end, s."""


class CameraApart:
    """`rig.cameras.camera.DepthCamera` whose methods are run in a child process, with deadlines.

    A call that goes beyond its deadline ends the child with a `CameraTimeout`; `open` starts
    another. A child that ends by itself is a `CameraError`.
    """

    def __init__(
        self,
        kind: str,
        values: Mapping[str, Any],
        *,
        open_timeout: float = 60.0,
        hang: float = 10.0,
    ) -> None:
        """`kind` and `values` as `rig.cameras.make` takes them; nothing is started yet.

        Args:
            kind: the camera's name.
            values: its options.
            open_timeout: for `open`, s.
            hang: how much longer than its own time-out a capture may take, s.
        """
        self._kind, self._values = kind, dict(values)
        self._open_timeout, self._hang = open_timeout, hang
        self._child: subprocess.Popen[bytes] | None = None
        self._answers: queue.SimpleQueue[tuple[str, Any] | None] = queue.SimpleQueue()
        self._said: collections.deque[str] = collections.deque(maxlen=5)

    @property
    def pid(self) -> int | None:
        """Of the child; None: there is none."""
        return None if self._child is None else self._child.pid

    def open(self) -> CameraInfo:
        """See `DepthCamera`; what was open before is closed."""
        self.close()
        self._start()
        info: CameraInfo = self._ask("open", self._open_timeout, self._kind, self._values)
        return info

    def capture(self, timeout: float) -> Capture:
        """See `DepthCamera`."""
        if self._child is None:
            raise CameraError(f"camera {self._kind!r}: not open, expected open() first")
        capture: Capture = self._ask("capture", timeout + self._hang, timeout)
        return capture

    def close(self) -> None:
        """See `DepthCamera`."""
        child, self._child = self._child, None
        if child is None:
            return
        assert child.stdin is not None
        with contextlib.suppress(OSError):
            child.stdin.close()
        try:
            child.wait(_PARTING)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()

    def _start(self) -> None:
        root = str(Path(__file__).parents[2])
        environment = dict(os.environ)
        paths = [root, *filter(None, [environment.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
        self._answers, self._said = queue.SimpleQueue(), collections.deque(maxlen=5)
        self._child = subprocess.Popen(
            [sys.executable, "-m", "rig.cameras.apart_child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
        )
        assert self._child.stdout is not None and self._child.stderr is not None
        for target, arguments in (
            (_hear, (self._child.stdout, self._answers)),
            (_note, (self._child.stderr, self._said)),
        ):
            threading.Thread(target=target, args=arguments, daemon=True).start()

    def _ask(self, do: str, deadline: float, *arguments: Any) -> Any:
        child = self._child
        assert child is not None and child.stdin is not None
        try:
            pickle.dump((do, arguments), child.stdin, protocol=5)
            child.stdin.flush()
            answer = self._answers.get(timeout=deadline)
        except OSError:
            answer = None
        except queue.Empty:
            self.end()
            raise CameraTimeout(
                f"camera {self._kind!r}: hangs, no answer to {do!r} within {deadline:g} s; its"
                " process was ended"
            ) from None
        except BaseException:
            # An answer that nobody waited for must not pass for that of the next question.
            self.end()
            raise
        if answer is None:
            self.end()
            words = f" ({self._said[-1]})" if self._said else ""
            raise CameraError(f"camera {self._kind!r}: its process ended{words}, expected a frame")
        how, value = answer
        if how == "timeout":
            raise CameraTimeout(value)
        if how == "missing":
            raise MissingPackage(value)
        if how == "error":
            raise CameraError(value)
        return value

    def end(self) -> None:
        """End the child at once, whatever it does."""
        child, self._child = self._child, None
        if child is not None:
            child.kill()
            child.wait()


def _hear(stream: IO[bytes], answers: queue.SimpleQueue[tuple[str, Any] | None]) -> None:
    with stream:
        while True:
            try:
                answers.put(pickle.load(stream))
            except (EOFError, OSError, pickle.UnpicklingError):
                break
    answers.put(None)


def _note(stream: IO[bytes], said: collections.deque[str]) -> None:
    with stream:
        for line in stream:
            if line.strip():
                said.append(" ".join(line.decode("utf-8", "replace").split()))
