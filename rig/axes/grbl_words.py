"""What a GRBL 1.1 controller says: status reports, errors and alarms.

After the interface description of GRBL 1.1.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ALARMS = {
    1: "hard limit: a switch was hit, the position is lost",
    2: "soft limit: the target is outside the machine's travel",
    3: "reset while moving: the position is lost",
    4: "probe: not in the state expected at its start",
    5: "probe: no contact",
    6: "homing: reset while homing",
    7: "homing: the door was opened",
    8: "homing: a switch stayed closed in the pull-off",
    9: "homing: no switch found",
}
ERRORS = {
    1: "no letter where one was expected",
    2: "no number where one was expected",
    3: "unknown $ command",
    5: "homing is not enabled ($22)",
    8: "not possible while it moves",
    9: "locked by an alarm or a jog",
    11: "line too long",
    13: "the door is open",
    15: "outside the machine's travel",
    20: "unknown G-code",
    22: "no feed rate",
    33: "a target that cannot be reached",
}

_MOVING = ("Run", "Jog", "Home", "Hold:1")
_BLOCKED = {
    "Hold:0": "feed hold",
    "Door": "the door is open",
    "Sleep": "asleep",
    "Check": "check mode: it moves nothing",
}


@dataclass(frozen=True, eq=False)
class Report:
    """A status report; places in mm, in the machine's frame or the work's, as they were sent."""

    state: str
    """As ``Idle``, ``Run``, ``Hold:1``, ``Alarm``."""
    machine: Array | None
    """MPos."""
    work: Array | None
    """WPos."""
    offset: Array | None
    """WCO: MPos = WPos + WCO. In some reports only."""

    @property
    def moving(self) -> bool:
        """Whether the axes move."""
        return self.state in _MOVING

    @property
    def blocked(self) -> str | None:
        """What but an alarm keeps it from moving, in words."""
        return _BLOCKED.get(self.state) or _BLOCKED.get(self.state.partition(":")[0])


def parse_report(line: str) -> Report | None:
    """Return the report in a line such as ``<Idle|MPos:0.000,0.000,0.000|FS:0,0>``; None: none."""
    match = re.fullmatch(r"<([A-Za-z]+(?::\d)?)\|(.*)>", line.strip())
    if match is None:
        return None
    places: dict[str, Array] = {}
    for field in match[2].split("|"):
        name, _, text = field.partition(":")
        if name in ("MPos", "WPos", "WCO"):
            try:
                places[name] = np.array([float(word) for word in text.split(",")])
            except ValueError:
                return None
    if "MPos" not in places and "WPos" not in places:
        return None
    return Report(match[1], places.get("MPos"), places.get("WPos"), places.get("WCO"))


def code_of(line: str, kind: str) -> int | None:
    """Return n of a line ``kind:n``, None where it is another."""
    match = re.fullmatch(rf"{kind}:(\d+)", line.strip())
    return int(match[1]) if match else None


def alarm_words(code: int | None) -> str:
    """Return an alarm in words."""
    if code is None:
        return "locked until it is homed"
    return f"{ALARMS.get(code, 'unknown alarm')} (ALARM:{code})"


def error_words(code: int) -> str:
    """Return an error in words."""
    return f"{ERRORS.get(code, 'unknown error')} (error:{code})"


HOMING = 60.0
"""For homing where the settings do not say how long it may take, s."""


def homing_time(settings: Mapping[str, str]) -> float:
    """How long homing may take by a controller's settings, s; `HOMING` where they do not say.

    GRBL looks for a switch over 1.5 times the travel and then gives up by itself (its limits.c);
    the axes may go one after the other, and approach their switches a second time, slowly.
    """
    try:
        travel = sum(abs(float(settings[f"$13{axis}"])) for axis in range(3))
        slow, fast, pull_off = (float(settings[name]) for name in ("$24", "$25", "$27"))
        seconds = 60.0 * (1.5 * travel / fast + 3.0 * 10.0 * pull_off / slow)
    except (KeyError, ValueError, ZeroDivisionError):
        return HOMING
    return 1.2 * seconds + 3.0
