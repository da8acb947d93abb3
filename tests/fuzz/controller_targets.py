"""Targets at the ports of the simulated controller, spoken to over real sockets.

An input is what a client sends. The controller must hang up or answer, and go on for others.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from tests.fuzz import mutating
from tests.fuzz.mutating import Mutator
from tests.fuzz.targets import Target

FILE = "sent"
SCRIPTS = 30003
_CONTROLLED = b"def rtde_control():\n  reg_offset_int = 0\n  reg_offset_float = 0\nend\n"
_CYCLE = 0.004
_MOST = 4096
PASSES = 0.03
"""How long the controller may run a program after all was sent, s."""


def _packets() -> bytes:
    """What a client of RTDE begins with."""
    outputs = struct.pack(">d", 500.0) + b"timestamp,actual_q,runtime_state,output_int_register_0"
    inputs = b"input_int_register_0,input_double_register_0,input_double_register_1"
    messages = (
        (b"V", struct.pack(">H", 2)),
        (b"v", b""),
        (b"O", outputs),
        (b"I", inputs),
        (b"S", b""),
        (b"U", b"\x01" + struct.pack(">idd", 37, 0.1, 0.2)),
        (b"U", b"\x01" + struct.pack(">idd", 1, 0.1, 0.2)),
    )
    return b"".join(struct.pack(">H", len(body) + 3) + kind + body for kind, body in messages)


_SCRIPT = b"""def moves():
  reg_offset_int = 0
  movej([-1.9, -1.5, 1.4, -1.4, -1.5, -0.3], a=1.0, v=1.0)
  movel(p[0.3, 0.3, 0.3, 0.0, 3.1, 0.0], a=0.5, v=0.2)
end
"""
_CONTROL = b"""{"do": "about"}
{"do": "fault", "name": "slow", "on": true}
{"do": "place", "joints": [-1.9, -1.5, 1.4, -1.4, -1.5, -0.3]}
"""
_DASHBOARD = (
    b"PolyscopeVersion\nget serial number\nis in remote control\nunlock protective stop\nstop\n"
)


def _address() -> str:
    return f"127.{200 + os.getpid() % 50}.{(os.getpid() // 50) % 256}.77"


def _commands() -> bytes:
    """What a client asks of its control script: moves, poses, stops."""
    names = [f"input_double_register_{k}" for k in range(8)]
    inputs = ",".join(["input_int_register_0", "input_int_register_1", *names]).encode()
    pose = (0.3, 0.3, 0.3, 0.0, 3.1, 0.0, 1.0, 1.0)
    joints = (-1.9, -1.5, 1.4, -1.4, -1.5, -0.3, 1.0, 1.0)
    asked = ((1, joints), (2, pose), (3, pose), (4, joints), (29, pose), (30, pose), (43, pose))
    asked += ((36, pose), (37, joints), (45, pose), (58, pose), (33, pose), (34, pose), (255, pose))
    packets = [(b"I", inputs)]
    for number, values in asked:
        packets += [(b"U", b"\x01" + struct.pack(">ii8d", k, 0, *values)) for k in (number, 0)]
    return b"".join(struct.pack(">H", len(body) + 3) + kind + body for kind, body in packets)


def _make(sent: bytes, path: Path) -> None:
    path.mkdir()
    (path / FILE).write_bytes(sent)


def _send(port: int, path: Path, before: bytes = b"") -> None:
    """Send the file to a controller, which must then still answer others.

    Args:
        port: where.
        path: the folder.
        before: a program that runs by then; the file's packets are then sent one by one, each
            when the program may have seen the one before.
    """
    from sim.controller.machine import Machine
    from sim.controller.options import CONTROL_PORT, ControllerOptions
    from sim.controller.server import Server

    host = _address()
    server = Server(Machine(ControllerOptions(host=host, speed=20.0)))
    ended: list[BaseException] = []

    def serve() -> None:
        try:
            server.serve()
        except BaseException as error:
            ended.append(error)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        data = (path / FILE).read_bytes()
        if before:
            with socket.create_connection((host, SCRIPTS), 5.0) as client:
                client.sendall(before)
                time.sleep(PASSES)
        with socket.create_connection((host, port), 5.0) as client:
            client.settimeout(0.2)
            with contextlib.suppress(OSError):  # it may hang up
                for part in _packets_of(data[:_MOST]) if before else (data,):
                    client.sendall(part)
                    if before:
                        time.sleep(_CYCLE)
            time.sleep(PASSES)
            with socket.create_connection((host, CONTROL_PORT), 5.0) as other:
                other.settimeout(2.0)
                other.sendall(b'{"do": "about"}\n')
                try:
                    answer = other.recv(1 << 16)
                except OSError as error:
                    if not ended:
                        raise AssertionError(f"others get no answer: {error}") from error
        if ended:
            raise ended[0]
        if not answer and not ended and b"kill" not in data:
            raise AssertionError("others get no answer")
    finally:
        server.end()
        thread.join(10.0)
        server.close()
    if ended:
        raise ended[0]


def _port(name: str, port: int, sent: bytes, mutate: Mutator) -> Target:
    return Target(f"controller-{name}", partial(_make, sent), FILE, partial(_send, port), mutate)


def _packets_of(data: bytes) -> Iterator[bytes]:
    while len(data) >= 2:
        size = max(2, struct.unpack_from(">H", data)[0])
        yield data[:size]
        data = data[size:]


def _one_by_one(path: Path) -> None:
    """Send commands to a running control script."""
    _send(30004, path, _CONTROLLED)


TARGETS = (
    Target(
        "controller-commands",
        partial(_make, _commands()),
        FILE,
        _one_by_one,
        mutating.of_packets,
    ),
    _port("rtde", 30004, _packets(), mutating.of_packets),
    _port("script", SCRIPTS, _SCRIPT + _CONTROLLED, mutating.of_text),
    _port("dashboard", 29999, _DASHBOARD, mutating.of_text),
    _port("control", 29990, _CONTROL, mutating.of_lines),
)
