"""Lines of text over a serial port, each wait with an end."""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress
from typing import Any

from depthba.errors import MissingPackage
from rig.errors import AxesError

_SLICE = 0.05
"""Longest wait of one read, s."""


class SerialLink:
    """An open port. Every failure of it is an AxesError that begins with `who`."""

    def __init__(self, port: str, baud: int, who: str):
        try:
            import serial
        except ImportError as error:
            raise MissingPackage(
                "a G-code gantry needs the package pyserial: pip install 'depthba[rig]'"
            ) from error
        self._who = who
        self._buffer = b""
        self._writing = threading.Lock()
        self._failures = (serial.SerialException, OSError)
        try:
            self._serial: Any = serial.Serial(
                port, baud, timeout=_SLICE, write_timeout=1.0, exclusive=True
            )
        except (serial.SerialException, ValueError) as error:
            code = getattr(error, "errno", None)
            reason = os.strerror(code) if isinstance(code, int) else str(error)
            raise AxesError(f"{who}: cannot open the port: {reason}") from error

    def send(self, data: bytes) -> None:
        """Write bytes; another thread may read meanwhile."""
        with self._writing:
            try:
                self._serial.write(data)
            except self._failures as error:
                raise AxesError(f"{self._who}: the connection was lost: {error}") from error

    def line(self, deadline: float) -> str | None:
        """Return the next line that is not empty; None: there was none by then (monotonic, s)."""
        while True:
            head, found, rest = self._buffer.partition(b"\n")
            if found:
                self._buffer = rest
                if text := head.decode("ascii", errors="replace").strip():
                    return text
                continue
            if time.monotonic() > deadline:
                return None
            try:
                self._buffer += self._serial.read(max(1, self._serial.in_waiting))
            except self._failures as error:
                raise AxesError(f"{self._who}: the connection was lost") from error

    def drain(self) -> None:
        """Forget what has come and was not read."""
        self._buffer = b""
        try:
            self._serial.reset_input_buffer()
        except self._failures as error:
            raise AxesError(f"{self._who}: the connection was lost") from error

    def close(self) -> None:
        """Close the port; never raises."""
        with suppress(*self._failures):
            self._serial.close()
