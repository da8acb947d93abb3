"""The two simulated gantries as the tests of axes drive them, each over its own line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from rig.axes import Axes, Axis, GrblGantry, GrblOptions, ModbusGantry, ModbusOptions, Patience
from tests.rig.peers import loopback, peer

AXES = (Axis("x", 0.0, 0.795, 0.5), Axis("y", 0.0, 0.595, 0.4))
PATIENT = Patience(stall=1.0, settle=1.0)
NEAR = ("--mechanics.parked", "0.03", "0.02")
"""Close to the switches, so that homing takes little."""


def _modbus(where: str) -> ModbusGantry:
    host, port = where.split(":")
    options = ModbusOptions(host, AXES, port=int(port), patience=PATIENT, reply_timeout=2.0)
    return ModbusGantry(options)


def _grbl(where: str) -> GrblGantry:
    origin = (-0.8, -0.6)
    return GrblGantry(GrblOptions(where, AXES, origin=origin, patience=PATIENT, reply_timeout=2.0))


@dataclass(frozen=True)
class Device:
    """A simulated gantry, and how it differs from the other."""

    name: str
    words: tuple[str, ...]
    """Of its command line, always."""
    fast: tuple[str, ...]
    """Of a quick one."""
    made: Callable[[str], Axes]
    """Its driver, from where it listens."""
    rest: float
    """Where its axes stand once homed, m."""
    remembers: bool
    """Whether it knows that it was homed when another client comes."""
    alarm: str
    """What it says where a limit switch is hit."""
    no_switch: str
    silence: str


DEVICES = (
    Device(
        "modbus", ("--watchdog", "20", *NEAR), ("--rate", "8"), _modbus, 0.0, True,
        r"alarm during the move: limit switch \(code 2\), at x",
        "alarm while homing: reference switch not found", "no answer for .* within 2 s",
    ),
    Device(
        "grbl", NEAR, ("--rate", "8"), _grbl, 0.004, False,
        r"hard limit: a switch was hit, the position is lost \(ALARM:1\), at x 0\.2",
        r"no switch found \(ALARM:9\)", "no status report within 2 s",
    ),
)  # fmt: skip
both = pytest.mark.parametrize("device", DEVICES, ids=[device.name for device in DEVICES])


@contextmanager
def gantry(device: Device, *more: str, home: bool = True, fast: bool = True) -> Iterator[Axes]:
    """The driver of a new device, connected, and homed unless told otherwise."""
    words = (*device.words, *(device.fast if fast else ()), *more)
    if device.name == "modbus":
        words = ("--host", loopback(), "--port", "0", *words)
    with peer(f"sim.axes.{device.name}_device", *words) as (_, where):
        found = device.made(where)
        found.connect()
        if home:
            found.home()
        try:
            yield found
        finally:
            found.disconnect()
