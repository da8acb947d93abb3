"""A simulated gantry behind a GRBL 1.1 controller, on a pseudo-terminal.

Run as a process of its own: ``python -m sim.axes.grbl_device``. It prints one line, ``listening on
/dev/pts/N``, which a client opens as its serial port, and serves until it is ended.

The dialect is that of GRBL 1.1: ``$H``, ``$X``, ``$$``, G0, G1, G20, G21, G53, G90, G94, ``?``,
``!``, ``~``, soft reset 0x18; ``ok``, ``error:n``, ``ALARM:n``. As with the real one, homing is
asked for after power-up, nothing is said while it homes, the machine's frame is negative, and a
soft reset while moving loses the position.
"""

from __future__ import annotations

import os
import re
import select
import time
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from depthba.errors import OptionError
from sim.axes.carriage import Carriage, Doing, Mechanics
from sim.axes.serving import end_abruptly, end_with_parent
from sim.axes.stage import Stage, tell

_BANNER = "\r\nGrbl 1.1h ['$' for help]\r\n"
_UNLOCK = "[MSG:'$H'|'$X' to unlock]\r\n"
_NEEDS_RESET = "[MSG:Reset to continue]\r\n"
_KNOWN = {0.0, 1.0, 20.0, 21.0, 53.0, 90.0, 94.0}
_TICK = 0.005


@dataclass(frozen=True)
class Options:
    """A simulated gantry behind GRBL 1.1 on a pseudo-terminal; ends when it is killed."""

    report: Literal["machine", "work"] = "machine"
    """Which places the status reports give ($10)."""
    work_offset: tuple[float, float, float] = (-100.0, -50.0, 0.0)
    """Work offset that somebody left in the controller, mm."""
    homing: bool = True
    """Whether homing is enabled ($22)."""
    banner: bool = True
    """Off: it never greets, as another device at that port."""
    mute_homing: bool = False
    """It begins to home, and is never heard of again until it is reset."""
    rate: float = 1.0
    """How many times faster than real its time runs."""
    mechanics: Mechanics = field(default_factory=Mechanics)
    stage: Stage = field(default_factory=Stage)
    """What stands around it."""
    end_with_parent: bool = False
    """End as soon as the process that started it is gone."""


class GrblDevice:
    """The controller's program: bytes in, bytes out. `now` is on the device's own clock, s."""

    def __init__(self, options: Options):
        self.options = options
        self.carriage = Carriage(options.mechanics)
        self._travel = 1e3 * np.array(options.mechanics.upper)
        self._shift = np.zeros_like(self._travel)  # of the machine's frame, mm; known once homed
        self._buffer = ""
        self._lines: list[str] = []
        self._state: Literal["idle", "alarm", "halted"] = "alarm" if options.homing else "idle"
        self._hold = False
        self._homing = False
        self._feed = 0.0
        self._unit = 1.0
        self._reports = 0
        self._out = ""

    def feed(self, data: bytes, now: float) -> bytes:
        """Take bytes, let time pass until `now`, return what is said."""
        self._pass(now)
        for byte in data:
            if byte == 0x18:
                self._reset(now)
            elif byte in b"?":
                self._report(now)
            elif byte in b"!":
                self._feed_hold(now)
            elif byte in b"~":
                self._hold = False
            elif byte in b"\r\n":
                if self._buffer.strip():
                    self._lines.append(self._buffer.strip())
                self._buffer = ""
            else:
                self._buffer += chr(byte)
        while self._lines and not self._homing and self._state != "halted":
            said = self._obey(self._lines.pop(0), now)  # an alarm goes out before it
            self._out += said
        out, self._out = self._out, ""
        return out.encode("ascii")

    def greet(self) -> bytes:
        """Return what is said after power-up."""
        return (_BANNER + (_UNLOCK if self._state == "alarm" else "")).encode("ascii")

    def _pass(self, now: float) -> None:
        doing = self.carriage.doing(now)
        if self.carriage.alarm == "limit":
            self.carriage.alarm = None
            self._halt(1)
        if self._homing and doing is not Doing.HOMING and not self.options.mute_homing:
            self._homing = False
            if self.carriage.alarm == "switch":
                self.carriage.alarm = None
                self._halt(9)
            else:
                self._state, self._shift = "idle", -self._travel
                self._out += "ok\r\n"

    def _halt(self, alarm: int) -> None:
        self._state = "halted"
        self._out += f"ALARM:{alarm}\r\n{_NEEDS_RESET}"

    def _reset(self, now: float) -> None:
        doing = self.carriage.doing(now)
        if doing is not Doing.STANDING:
            self.carriage.cut(now)
            self._out += f"ALARM:{6 if self._homing else 3}\r\n"
            self._state = "alarm"
        elif self._state == "halted":
            self._state = "alarm"
        self._hold = self._homing = False
        self._buffer, self._lines = "", []
        if self.options.banner:
            self._out += _BANNER + (_UNLOCK if self._state == "alarm" else "")

    def _feed_hold(self, now: float) -> None:
        if self._state == "idle" and not self._homing:
            self.carriage.brake(now)
            self._hold = True

    def _report(self, now: float) -> None:
        if self._homing:
            return
        moving = self.carriage.doing(now) is not Doing.STANDING
        state = "Run" if moving else "Idle"
        if self._hold:
            state = "Hold:1" if moving else "Hold:0"
        if self._state != "idle":
            state = "Alarm"
        machine = np.zeros(3)
        machine[: len(self._travel)] = 1e3 * self.carriage.position(now) + self._shift
        offset = np.array(self.options.work_offset)
        work = self.options.report == "work"
        shown = machine - offset if work else machine
        fields = [f"{'WPos' if work else 'MPos'}:{_numbers(shown)}", "FS:0,0"]
        if self._reports % 10 == 0:
            fields.append(f"WCO:{_numbers(offset)}")
        self._reports += 1
        self._out += f"<{'|'.join([state, *fields])}>\r\n"

    def _obey(self, line: str, now: float) -> str:
        if line == "$$":
            settings: dict[str, float] = {
                "$10": int(self.options.report == "machine"),
                "$13": 0,
                "$20": 1,
                "$22": int(self.options.homing),
                "$24": round(60e3 * self.options.mechanics.creep_speed, 3),
                "$25": round(60e3 * self.options.mechanics.homing_speed, 3),
                "$27": round(1e3 * self.options.mechanics.pull_off, 3),
            }
            settings |= {f"$13{k}": 0.0 for k in range(3)}
            settings |= {f"$13{k}": round(mm, 3) for k, mm in enumerate(self._travel)}
            return "".join(f"{name}={value}\r\n" for name, value in settings.items()) + "ok\r\n"
        if line == "$H":
            if not self.options.homing:
                return "error:5\r\n"
            self._homing = True
            self.carriage.home(now, leave=self.options.mechanics.pull_off)
            return ""
        if line == "$X":
            self._state = "idle"
            return "ok\r\n"
        if line.startswith("$"):
            return "error:3\r\n"
        if self._state != "idle":
            return "error:9\r\n"
        return self._block(line, now)

    def _block(self, line: str, now: float) -> str:
        """Obey a block of G-code."""
        text = re.sub(r"\s|\(.*?\)", "", line).upper()
        words = re.findall(r"([A-Z])([-+]?\d*\.?\d+)", text)
        if "".join(a + b for a, b in words) != text:
            return "error:2\r\n"
        codes = {float(value) for letter, value in words if letter == "G"}
        values = {letter: float(value) for letter, value in words if letter != "G"}
        if codes - _KNOWN or set(values) - set("XYZF"):
            return "error:20\r\n"
        self._unit = 25.4 if 20 in codes else 1.0 if 21 in codes else self._unit
        self._feed = values.get("F", self._feed / self._unit) * self._unit
        if not values.keys() & set("XYZ"):
            return "ok\r\n"
        if self._feed <= 0:
            return "error:22\r\n"
        target = 1e3 * self.carriage.position(now) + self._shift
        for row in range(len(self._travel)):
            if "XYZ"[row] in values:
                target[row] = values["XYZ"[row]] * self._unit
                target[row] += 0.0 if 53 in codes else self.options.work_offset[row]
        if np.any(target > 0) or np.any(target < -self._travel):
            self._halt(2)
            return ""
        self.carriage.move((target - self._shift) / 1e3, self._feed / 60e3, now)
        return "ok\r\n"


def serve(options: Options) -> None:
    """Serve on a new pseudo-terminal until the process ends; says where it is."""
    import tty

    if len(options.mechanics.upper) > 3:
        raise OptionError(f"{len(options.mechanics.upper)} axes, expected at most 3")
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    device = GrblDevice(options)
    tell(options.stage, lambda: device.carriage.glimpse(options.rate * time.monotonic()))
    if options.end_with_parent:
        end_with_parent()
    print(f"listening on {os.ttyname(theirs)}", flush=True)
    if options.banner:
        os.write(ours, device.greet())
    while True:
        ready = select.select([ours], [], [], _TICK)[0]
        data = os.read(ours, 1024) if ready else b""
        said = device.feed(data, options.rate * time.monotonic())
        fault = device.carriage.fault
        if fault == "drop":
            end_abruptly()
        if said and fault != "silent":
            os.write(ours, said)


def _numbers(values: np.ndarray) -> str:
    return ",".join(f"{value:.3f}" for value in values)


def main() -> None:
    """Serve until the process is ended."""
    from sim.axes.serving import run

    run(Options, serve)


if __name__ == "__main__":
    main()
