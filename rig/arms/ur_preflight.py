"""Whether a UR controller is there and can be driven: asked with plain sockets and deadlines.

The client library waits minutes for a host that does not answer, and for ever for one that accepts
a connection and says nothing. So each of the three ports is tried first, and what the library would
need from it.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rig.errors import ArmError, EmergencyStop, ProtectiveStop, Stopped

RTDE, SCRIPT, DASHBOARD = 30004, 30003, 29999

_HEADER = struct.Struct(">HB")
_VERSION, _OUTPUTS, _START, _DATA = b"VOSU"


@dataclass(frozen=True)
class Greeting:
    """What the controller's dashboard says of itself."""

    software: str
    """As "URSoftware 5.15.0.0 (Jun 01 2023)"."""
    serial: str
    remote: bool
    """Whether it obeys a program from outside; controllers before 5.6 cannot say, and do."""
    safety: str
    """As "NORMAL"."""
    mode: str
    """As "RUNNING"."""


def preflight(host: str, patience: float) -> Greeting:
    """Try the three ports; no answer may take longer than `patience` s.

    ArmError names the port, what was found there and what was expected; ProtectiveStop,
    EmergencyStop or Stopped where a safety stop holds the arm.
    """
    _try_rtde(host, patience)
    with _reached(host, SCRIPT, "script port", patience):
        pass
    greeting = ask_dashboard(host, patience)
    at = f"{host}:{DASHBOARD}"
    refuse_stop(host, greeting.safety)
    if not greeting.remote:
        raise ArmError(
            f"{at}: the robot is in local mode; expected remote control, which the teach pendant"
            " switches to"
        )
    if greeting.mode not in ("RUNNING", ""):
        raise ArmError(f"{at}: the robot is {greeting.mode}; expected RUNNING: power it on")
    return greeting


def refuse_stop(host: str, safety: str) -> None:
    """Raise what fits the dashboard's word for the safety system's state."""
    if safety in ("NORMAL", "REDUCED", ""):
        return
    kind: type[ArmError] = Stopped
    if safety == "PROTECTIVE_STOP":
        kind = ProtectiveStop
    elif "EMERGENCY" in safety:
        kind = EmergencyStop
    word = safety.lower().replace("_", " ")
    raise kind(f"{host}: {word}; expected a person to look at the robot and release it")


def ask_dashboard(host: str, patience: float) -> Greeting:
    """What the dashboard says; ArmError where it does not, or is none."""
    with _reached(host, DASHBOARD, "dashboard", patience) as peer:
        lines = _Lines(peer, host, patience)
        banner = lines.read("the dashboard's banner")
        if "Dashboard" not in banner:
            raise ArmError(
                f"{host}:{DASHBOARD}: says {banner[:60]!r}, expected a dashboard's banner"
            )
        remote = lines.ask("is in remote control").lower()
        return Greeting(
            software=lines.ask("PolyscopeVersion"),
            serial=lines.ask("get serial number"),
            remote=remote.startswith("true") or "understand" in remote,
            safety=_after_colon(lines.ask("safetystatus")),
            mode=_after_colon(lines.ask("robotmode")),
        )


def _after_colon(answer: str) -> str:
    """The state in an answer such as "Robotmode: RUNNING"; empty where it is none."""
    _, colon, state = answer.partition(": ")
    return state.strip().upper() if colon and "understand" not in answer else ""


def _try_rtde(host: str, patience: float) -> None:
    """Go through the handshake of RTDE up to the first data."""
    with _reached(host, RTDE, "RTDE", patience) as peer:
        accepted = _converse(peer, host, patience, _VERSION, struct.pack(">H", 2))
        if accepted[:1] != b"\x01":
            raise ArmError(f"{host}:{RTDE}: refuses protocol 2, expected a controller that has it")
        _converse(peer, host, patience, _OUTPUTS, struct.pack(">d", 125.0) + b"timestamp")
        _converse(peer, host, patience, _START, b"")
        _await(peer, host, patience, _DATA, "handshakes but sends no data, expected its state")


def _converse(peer: socket.socket, host: str, patience: float, kind: int, content: bytes) -> bytes:
    try:
        peer.sendall(_HEADER.pack(len(content) + _HEADER.size, kind) + content)
    except OSError as error:
        raise ArmError(f"{host}:{RTDE}: {_reason(error)}, expected RTDE") from None
    silence = "accepts connections but says nothing, expected an answer to RTDE's handshake"
    return _await(peer, host, patience, kind, silence)


def _await(peer: socket.socket, host: str, patience: float, kind: int, silence: str) -> bytes:
    """The content of the next message of a kind; others are passed over."""
    deadline, buffer = time.monotonic() + patience, bytearray()
    while True:
        while len(buffer) >= _HEADER.size:
            size, found = _HEADER.unpack_from(buffer)
            if size < _HEADER.size:
                raise ArmError(f"{host}:{RTDE}: sends something else, expected RTDE")
            if len(buffer) < size:
                break
            content = bytes(buffer[_HEADER.size : size])
            del buffer[:size]
            if found == kind:
                return content
        left = deadline - time.monotonic()
        try:
            if left <= 0.0:
                raise TimeoutError
            peer.settimeout(left)
            data = peer.recv(4096)
        except TimeoutError:
            raise ArmError(f"{host}:{RTDE}: {silence} within {patience:g} s") from None
        except OSError as error:
            raise ArmError(f"{host}:{RTDE}: {_reason(error)}, expected RTDE") from None
        if not data:
            raise ArmError(f"{host}:{RTDE}: hangs up, expected an answer to RTDE's handshake")
        buffer += data


class _Lines:
    """A peer that speaks in lines."""

    def __init__(self, peer: socket.socket, host: str, patience: float) -> None:
        self._peer, self._host, self._patience = peer, host, patience
        self._incoming = b""

    def ask(self, question: str) -> str:
        try:
            self._peer.sendall(question.encode() + b"\n")
        except OSError as error:
            raise ArmError(f"{self._host}:{DASHBOARD}: {_reason(error)}") from None
        return self.read(f"an answer to {question!r}")

    def read(self, what: str) -> str:
        deadline = time.monotonic() + self._patience
        while b"\n" not in self._incoming:
            left = deadline - time.monotonic()
            try:
                if left <= 0.0:
                    raise TimeoutError
                self._peer.settimeout(left)
                data = self._peer.recv(4096)
            except TimeoutError:
                raise ArmError(
                    f"{self._host}:{DASHBOARD}: accepts connections but says nothing, expected"
                    f" {what} within {self._patience:g} s"
                ) from None
            except OSError as error:
                raise ArmError(
                    f"{self._host}:{DASHBOARD}: {_reason(error)}, expected {what}"
                ) from None
            if not data:
                raise ArmError(f"{self._host}:{DASHBOARD}: hangs up, expected {what}")
            self._incoming += data
        line, _, self._incoming = self._incoming.partition(b"\n")
        return line.decode("utf-8", "replace").strip()


@contextmanager
def _reached(host: str, port: int, what: str, patience: float) -> Iterator[socket.socket]:
    expected = f"expected a UR controller's {what}"
    try:
        peer = socket.create_connection((host, port), patience)
    except TimeoutError:
        raise ArmError(
            f"{host}:{port}: unreachable, no answer within {patience:g} s; {expected}"
        ) from None
    except OSError as error:
        raise ArmError(f"{host}:{port}: {_reason(error)}; {expected}") from None
    with peer:
        yield peer


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
