"""Ctrl-C and requests to end: raised at once, kept back while a frame is written, never lost."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

_NUMBERS = (signal.SIGINT, signal.SIGTERM)


class Interrupts:
    """What asks this process to end, and whether it has.

    A signal becomes a KeyboardInterrupt wherever the main thread happens to be. Where that is a
    finaliser or a callback of the interpreter, Python prints it and goes on; so it is remembered,
    and `check` raises it again.
    """

    def __init__(self) -> None:
        """Nothing was asked yet."""
        self._asked = False
        self._holding = 0

    @contextlib.contextmanager
    def heard(self) -> Iterator[None]:
        """Hear Ctrl-C and SIGTERM while the block lasts, whatever was done with them before.

        A script that starts a program in the background lets it ignore Ctrl-C. In threads other
        than the main one this does nothing: signals are not heard there.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._hear) for number in _NUMBERS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Let what is heard wait until the block has ended."""
        self._holding += 1
        try:
            yield
        finally:
            self._holding -= 1
        self.check()

    def check(self) -> None:
        """Raise KeyboardInterrupt if this process was asked to end."""
        if self._asked:
            raise KeyboardInterrupt

    def _hear(self, number: int, frame: FrameType | None) -> None:
        self._asked = True
        if not self._holding:
            raise KeyboardInterrupt
