"""One client of one port: what it asked that is not answered yet, and how it is answered."""

from __future__ import annotations

import json
import math
import re
import socket
import struct
from typing import Any

from depthba.documents import parse_json
from sim.controller import dashboard, protocol
from sim.controller.machine import Machine
from sim.controller.protocol import DATA, INPUTS, OUTPUTS, Recipe, Value, message
from sim.errors import SimulationError

_LAZY = 1 << 16
"""To a client that has so many bytes to read yet, no data are sent."""
_LONGEST = 1 << 20
"""No line and no program has more bytes; a client that sends more without an end is hung up on."""


class Connection:
    """A client; each kind of port has its own `handle`."""

    def __init__(self, peer: socket.socket, machine: Machine) -> None:
        """`peer` must not block."""
        self.peer, self.machine = peer, machine
        self.closed = False
        self._incoming, self._outgoing = bytearray(), bytearray()

    def refuse_endless(self) -> None:
        """SimulationError where what is not answered yet has grown too long."""
        if len(self._incoming) > _LONGEST:
            raise SimulationError(
                f"{len(self._incoming)} bytes without an end, expected {_LONGEST} at most"
            )

    def greet(self) -> None:
        """Say what such a port says first."""

    def handle(self) -> None:
        """Answer what has come."""

    def receive(self) -> None:
        """Take what is there; it is answered by `handle`."""
        try:
            data = self.peer.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        self.closed |= not data
        self._incoming += data

    def send(self, data: bytes) -> None:
        """Send, now or as soon as the client reads."""
        self._outgoing += data
        if not self._outgoing:
            return
        try:
            del self._outgoing[: self.peer.send(self._outgoing)]
        except BlockingIOError:
            pass
        except OSError:
            self.closed = True

    @property
    def lazy(self) -> bool:
        """Whether it does not read."""
        return len(self._outgoing) > _LAZY

    def close(self) -> None:
        """Hang up."""
        self.closed = True
        self.peer.close()


class Rtde(Connection):
    """Port 30004."""

    def __init__(self, peer: socket.socket, machine: Machine) -> None:
        """See `Connection`."""
        super().__init__(peer, machine)
        self.streaming = False
        self._outputs = Recipe.of(())
        self._inputs: dict[int, Recipe] = {}
        self._limit = 500.0 if machine.options.version[0] > 3 else 125.0
        self._period, self._due = 1.0 / self._limit, 0.0

    def handle(self) -> None:
        """Answer each whole message."""
        for kind, content in protocol.messages(self._incoming):
            self._answer(kind, content)

    def _answer(self, kind: int, content: bytes) -> None:
        if kind == protocol.VERSION:
            known = struct.unpack(">H", content)[0] == 2
            self.send(message(kind, bytes([known])))
        elif kind == protocol.CONTROLLER_VERSION:
            self.send(message(kind, struct.pack(">4I", *self.machine.options.version)))
        elif kind == OUTPUTS:
            rate = struct.unpack_from(">d", content)[0]
            if not math.isfinite(rate):
                raise SimulationError(f"RTDE: data {rate} times a second, expected a number")
            self._period = 1.0 / min(max(rate, 1.0), self._limit)
            asked = Recipe.of(protocol.names_in(content[8:]))
            self._outputs = asked if asked.valid else Recipe.of(())
            self.send(message(kind, bytes([asked.valid]) + asked.described()))
        elif kind == INPUTS:
            recipe = Recipe.of(protocol.names_in(content), self.machine.taken)
            number = 0
            if recipe.valid:
                number = len(self._inputs) + 1
                self._inputs[number] = recipe
            self.send(message(kind, bytes([number]) + recipe.described()))
        elif kind in (protocol.START, protocol.PAUSE):
            self.streaming, self._due = kind == protocol.START, 0.0
            self.send(message(kind, b"\x01"))
        elif kind == DATA and content and content[0] in self._inputs:
            self.machine.take_inputs(self._inputs[content[0]].unpack(content[1:]))
        else:
            raise SimulationError(f"RTDE: a message of kind {kind}, which nobody expects here")

    def wants(self, now: float) -> bool:
        """Whether a package is due; it is taken to be sent then."""
        if not self.streaming or now < self._due:
            return False
        self._due = self._due or now
        self.send(b"")
        if self.lazy:
            return False
        # Late ones are made up for, unless they are too many.
        self._due = max(self._due + self._period, now - 5.0 * self._period)
        return True

    def give(self, values: dict[str, Value]) -> None:
        """Send a package."""
        self.send(message(DATA, b"\x01" + self._outputs.pack(values)))


class Script(Connection):
    """Ports 30001 to 30003: programs, each from ``def`` to an ``end`` in the first column."""

    _END = re.compile(rb"^end[ \t]*\r?\n", re.MULTILINE)

    def handle(self) -> None:
        """Run what is whole."""
        while found := self._END.search(self._incoming):
            script = bytes(self._incoming[: found.end()]).decode("latin1")
            del self._incoming[: found.end()]
            self.machine.take_script(script)
        self.refuse_endless()


class _Lines(Connection):
    """A port where a line is answered by a line."""

    def handle(self) -> None:
        """Answer each whole line."""
        while b"\n" in self._incoming:
            line, _, rest = self._incoming.partition(b"\n")
            self._incoming = bytearray(rest)
            answer = self._answer(line.decode("utf-8", "replace"))
            if answer is not None:
                self.send(answer.encode("utf-8", "replace") + b"\n")
        self.refuse_endless()

    def _answer(self, line: str) -> str | None:
        raise NotImplementedError


class Dashboard(_Lines):
    """Port 29999."""

    def greet(self) -> None:
        """The banner."""
        self.send(dashboard.BANNER.encode() + b"\n")

    def _answer(self, line: str) -> str | None:
        if line.strip().lower() == "quit":
            self.send(b"Disconnected\n")
            self.closed = True
            return None
        return dashboard.answer(line, self.machine.robot, self.machine.options.version)


class Control(_Lines):
    """The control channel: JSON objects, see `Machine.obey`; each answer has "ok" or "error"."""

    asked: list[dict[str, Any]]

    def __init__(self, peer: socket.socket, machine: Machine) -> None:
        """See `Connection`."""
        super().__init__(peer, machine)
        self.asked = []
        """What concerns the sockets, for the server to do and to answer."""

    def _answer(self, line: str) -> str | None:
        try:
            request = parse_json(line)
            if not isinstance(request, dict):
                raise ValueError(f"{line!r}: expected a JSON object")
            if request.get("do") in ("drop", "refuse", "kill"):
                self.asked.append(request)
                return None
            if request.get("do") == "expose" and "blind" in self.machine.faults:
                return None
            return json.dumps({"ok": True, **self.machine.obey(request)})
        except (ValueError, TypeError, OverflowError) as error:
            return json.dumps({"ok": False, "error": " ".join(str(error).split())})
