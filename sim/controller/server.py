"""The simulated controller's sockets and its clock, in one thread.

500 times a second time passes and clients get their data; between these moments requests are
answered. A machine that is too busy for that gets larger steps of time, not a slower clock.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import struct
import time
from collections.abc import Callable

from sim.controller import dashboard, protocol
from sim.controller.connections import Connection, Control, Dashboard, Rtde, Script
from sim.controller.machine import Machine
from sim.errors import SimulationError

PERIOD = 0.002
_IDLE = 0.02
"""Between two looks at the clock where nobody listens and nothing moves, s."""
_LONGEST = 0.1
"""No more time passes in one step, s: a machine that slept has lost it."""
_PARENT = 0.5
"""Between two looks whether the parent is still there, s."""

SCRIPT_PORTS = (30001, 30002, 30003)


class Server:
    """Serves one machine until `end` is called."""

    def __init__(self, machine: Machine) -> None:
        """Bind the ports; SimulationError names one that is taken."""
        self.machine = machine
        # Not epoll: it counts in milliseconds, of which a cycle has two.
        self._selector = selectors.SelectSelector()
        self._clients: list[Connection] = []
        self._listeners: list[socket.socket] = []
        self._ended = False
        self._parent = os.getppid()
        self._control = self._listen(machine.options.control_port, Control)
        try:
            self._open()
        except SimulationError:
            self.close()
            raise

    def serve(self, note: Callable[[str], None] = lambda line: None) -> None:
        """Run; `note` gets a line for each thing that happens."""
        last = due = time.monotonic()
        look = last + _PARENT
        while not self._ended:
            wait = max(due - time.monotonic(), 0.0)
            for key, _ in self._selector.select(wait):
                key.data()
            now = time.monotonic()
            if now < due:
                continue
            if "stalled" not in self.machine.faults:
                self._pass(min(now - last, _LONGEST), now)
            last = now
            due += self._period()
            if due < now - 10.0 * PERIOD:
                due = now
            while self.machine.robot.notes:
                note(self.machine.robot.notes.pop(0))
            if now > look:
                look = now + _PARENT
                if self.machine.options.end_with_parent and os.getppid() != self._parent:
                    self.end()

    def end(self) -> None:
        """Let `serve` return soon; may be called from a signal handler."""
        self._ended = True

    def close(self) -> None:
        """Hang up on everybody and let go of the ports."""
        self._refuse()
        for client in list(self._clients):
            self._hang_up(client)
        # Closed already, where a port was taken and the server never began.
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(self._control)
        self._control.close()
        self._selector.close()

    # Time

    def _period(self) -> float:
        machine = self.machine
        busy = (
            machine.program is not None
            or machine.robot.motion is not None
            or any(isinstance(client, Rtde) and client.streaming for client in self._clients)
        )
        return PERIOD if busy else _IDLE

    def _pass(self, seconds: float, now: float) -> None:
        """Let time pass, and tell who wants to know."""
        machine = self.machine
        machine.advance(seconds * machine.options.speed)
        if "no-data" in machine.faults:
            return
        due = [c for c in self._clients if isinstance(c, Rtde) and c.wants(now)]
        if due:
            values = machine.variables()
            for client in due:
                client.give(values)
                if client.closed:
                    self._hang_up(client)

    # Sockets

    def _open(self) -> None:
        kinds: dict[int, type[Connection]] = {
            protocol.PORT: Rtde,
            dashboard.PORT: Dashboard,
            **dict.fromkeys(SCRIPT_PORTS, Script),
        }
        for port, kind in kinds.items():
            self._listeners.append(self._listen(port, kind))

    def _listen(self, port: int, kind: type[Connection]) -> socket.socket:
        host = self.machine.options.host
        listener = socket.socket()
        try:
            # A controller that was ended may start again at once.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
            listener.listen(16)
        except OSError as error:
            listener.close()
            reason = error.strerror or str(error)
            raise SimulationError(
                f"{host}:{port}: {reason}; expected a free port, give another --host 127.x.y.z"
            ) from None
        listener.setblocking(False)
        self._selector.register(
            listener, selectors.EVENT_READ, lambda: self._accept(listener, kind)
        )
        return listener

    def _accept(self, listener: socket.socket, kind: type[Connection]) -> None:
        try:
            peer, _ = listener.accept()
        except OSError:
            return
        peer.setblocking(False)
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = kind(peer, self.machine)
        self._clients.append(client)
        self._selector.register(peer, selectors.EVENT_READ, lambda: self._read(client))
        if "stalled" not in self.machine.faults:
            client.greet()

    def _read(self, client: Connection) -> None:
        if client.closed:
            return
        client.receive()
        if "stalled" not in self.machine.faults or isinstance(client, Control):
            try:
                client.handle()
            except (SimulationError, ValueError, LookupError, struct.error) as error:
                self.machine.robot.notes.append(f"hung up on a client: {error}")
                client.closed = True
            except OSError:
                client.closed = True
        if client.closed:
            self._hang_up(client)
        elif isinstance(client, Control):
            while client.asked:
                self._obey(client.asked.pop(0))
                client.send(b'{"ok": true}\n')

    def _obey(self, request: dict[str, object]) -> None:
        if request["do"] == "kill":
            os._exit(1)
        self._drop()
        if request["do"] == "refuse":
            if request.get("on", True):
                self._refuse()
            elif not self._listeners:
                self._open()

    def _drop(self) -> None:
        for client in [c for c in self._clients if not isinstance(c, Control)]:
            self._hang_up(client)

    def _refuse(self) -> None:
        for listener in self._listeners:
            self._selector.unregister(listener)
            listener.close()
        self._listeners.clear()

    def _hang_up(self, client: Connection) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._selector.unregister(client.peer)
        client.close()
