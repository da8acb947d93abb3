"""The other end of the control channel: what tests, rehearsals and the simulated camera ask by."""

from __future__ import annotations

import json
import socket
import time
from types import TracebackType
from typing import Any

from sim.controller.options import CONTROL_PORT
from sim.errors import NoAnswer, SimulationError


class Channel:
    """A connection to a running controller's control channel; reached at the first question."""

    def __init__(self, host: str, port: int = CONTROL_PORT, timeout: float = 5.0) -> None:
        """`timeout`: for an answer, s, unless `ask` is told another."""
        self.host, self.port, self.timeout = host, port, timeout
        self._peer: socket.socket | None = None
        self._incoming = b""

    def ask(self, do: str, timeout: float | None = None, **arguments: Any) -> dict[str, Any]:
        """Send a request, return the answer; see `Machine.obey` for what there is.

        NoAnswer after `timeout` s; SimulationError where nobody listens, or the request is refused.
        """
        deadline = time.monotonic() + (self.timeout if timeout is None else timeout)
        try:
            if self._peer is None:
                left = max(deadline - time.monotonic(), 1e-3)
                self._peer = socket.create_connection((self.host, self.port), left)
                self._incoming = b""
            self._peer.settimeout(max(deadline - time.monotonic(), 1e-3))
            self._peer.sendall(json.dumps({"do": do, **arguments}).encode() + b"\n")
            if do == "kill":
                self.close()
                return {}
            answer = json.loads(self._line(deadline))
        except TimeoutError:
            self.close()
            raise NoAnswer(
                f"simulated controller {self.host}:{self.port}: no answer to {do!r} in time"
            ) from None
        except OSError as error:
            self.close()
            raise SimulationError(
                f"simulated controller {self.host}:{self.port}: {error.strerror or error};"
                " expected a running `depthba simulate-controller`"
            ) from None
        if not answer.pop("ok"):
            raise SimulationError(f"simulated controller {self.host}: {answer['error']}")
        return dict(answer)

    def close(self) -> None:
        """Hang up; the next question connects again."""
        if self._peer is not None:
            self._peer.close()
            self._peer = None

    def __enter__(self) -> Channel:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _line(self, deadline: float) -> bytes:
        assert self._peer is not None
        while b"\n" not in self._incoming:
            left = deadline - time.monotonic()
            if left <= 0.0:
                raise TimeoutError
            self._peer.settimeout(left)
            data = self._peer.recv(1 << 16)
            if not data:
                raise ConnectionResetError("the connection was closed")
            self._incoming += data
        line, _, self._incoming = self._incoming.partition(b"\n")
        return line
