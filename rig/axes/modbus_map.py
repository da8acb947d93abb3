"""The register map of a gantry's controller behind Modbus TCP.

A controller (PLC or drive) takes a command in holding registers and tells of itself in input
registers. One command is: its operands (speed, targets), then the code of the command, then a
sequence number other than the last. The controller acts when the sequence number changes, and
repeats the number in `acknowledged` once it acts: so an answer that belongs to an earlier command
cannot be mistaken for this one's.

============ ======= ====== =====================================================================
register     table   words  meaning
============ ======= ====== =====================================================================
command      holding 1      `Commands`: home, move, stop, reset
sequence     holding 1      counts commands, 1 to 65535, then 1 again; written last
speed        holding 2      signed, counts per second along the line
targets      holding 2 each signed, counts, one for each axis
status       input   1      bits of `StatusBits`
alarm        input   1      0: none; else a code of `alarms`
acknowledged input   1      sequence number of the last command that was taken
positions    input   2 each signed, counts, one for each axis
============ ======= ====== =====================================================================

The status registers are read in one request, so that they belong to one instant. A controller that
moves should stop by itself when no request reaches it for some time (a watchdog of 0.5 s or more):
no client can brake axes over a link that is lost.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from rig.errors import AxesError

_LONGEST_READ = 125
"""Registers that one request may read, by the Modbus specification."""


@dataclass(frozen=True)
class Commands:
    """Codes of the commands."""

    home: int = 1
    move: int = 2
    stop: int = 3
    reset: int = 4
    """Clears an alarm whose cause is gone."""


@dataclass(frozen=True)
class StatusBits:
    """Which bit of the status word says what; 0 is the lowest."""

    homed: int = 0
    moving: int = 1
    alarm: int = 2


@dataclass(frozen=True)
class RegisterMap:
    """Addresses as in the requests, counted from 0. Two axes by default."""

    command: int = 0
    sequence: int = 1
    speed: int = 2
    targets: tuple[int, ...] = (4, 6)
    status: int = 0
    alarm: int = 1
    acknowledged: int = 2
    positions: tuple[int, ...] = (4, 6)
    status_table: Literal["input", "holding"] = "input"
    """Where the controller keeps what it tells of itself."""
    word_order: Literal["big", "little"] = "big"
    """Of a number of two registers: big has the high word first."""
    commands: Commands = field(default_factory=Commands)
    bits: StatusBits = field(default_factory=StatusBits)
    alarms: tuple[tuple[int, str], ...] = (
        (1, "emergency stop"),
        (2, "limit switch"),
        (3, "following error"),
        (4, "no client for too long while moving"),
        (5, "not homed"),
        (6, "target outside the controller's limits"),
        (7, "reference switch not found"),
    )
    """Alarm codes in words."""

    def status_span(self) -> tuple[int, int]:
        """Return the first address and the count of the one request that reads the status."""
        first = min(self.status, self.alarm, self.acknowledged, *self.positions)
        last = max(self.status, self.alarm, self.acknowledged, *(p + 1 for p in self.positions))
        return first, last - first + 1

    def check(self, axes: int) -> None:
        """Refuse a map that does not fit that many axes. Raises AxesError."""
        for name, found in (("targets", self.targets), ("positions", self.positions)):
            if len(found) != axes:
                raise AxesError(f"register map: {len(found)} {name}, expected {axes}, one per axis")
        count = self.status_span()[1]
        if count > _LONGEST_READ:
            raise AxesError(
                f"register map: the status spans {count} registers,"
                f" expected at most {_LONGEST_READ}: one request reads it"
            )

    def alarm_words(self, code: int) -> str:
        """Return an alarm code in words."""
        return dict(self.alarms).get(code, "unknown alarm") + f" (code {code})"
