"""The mechanics of a simulated gantry: axes on rails with reference switches, and what can fail.

Time is given to every call, so that a controller asks for the state of an instant and nothing runs
in between.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim.axes.profile import Profile, braking, trapezoid

Array = NDArray[np.float64]

FaultKind = Literal["none", "stall", "alarm", "silent", "drop", "no-switch"]


@dataclass(frozen=True)
class Fault:
    """What goes wrong, once. All but no-switch happen in a move, not in homing."""

    kind: FaultKind = "none"
    """stall: the axes stand still, yet are said to move. alarm: a limit switch is hit. silent:
    nothing is answered any more. drop: the process ends. no-switch: homing finds no switch."""
    move: int = 1
    """In which move, counted from 1."""
    share: float = 0.5
    """After which share of that move's time."""


@dataclass(frozen=True)
class Mechanics:
    """What the axes are. Places are in the homed frame, m."""

    lower: tuple[float, ...] = (-0.005, -0.005)
    """Ends of the rails; the switches are at 0, so homing ends at 0 with the axes at them."""
    upper: tuple[float, ...] = (0.8, 0.6)
    parked: tuple[float, ...] = (0.31, 0.12)
    """Where the axes stand when the power comes on. The controller does not know."""
    acceleration: float = 2.0
    """m/s^2 along the line."""
    homing_speed: float = 0.25
    """Towards the switches, m/s."""
    creep_speed: float = 0.02
    """Back to the switches after the pull-off, m/s."""
    pull_off: float = 0.004
    """Away from the switches before they are approached again, m."""
    resolution: float = 1e-6
    """One step of the drives, m."""
    fault: Fault = field(default_factory=Fault)


class Doing(Enum):
    """What the axes are at."""

    STANDING = "standing"
    MOVING = "moving"
    HOMING = "homing"


@dataclass(frozen=True, eq=False)
class _Leg:
    """A straight piece of way, and when it began."""

    start: Array
    direction: Array
    """(n,), unit length; zeros for a leg without length."""
    profile: Profile
    began: float

    def at(self, now: float) -> tuple[Array, float]:
        """Return the place (n,), m, and the speed, m/s."""
        distance, speed = self.profile.at(now - self.began)
        return self.start + distance * self.direction, speed


class Carriage:
    """The axes of a gantry as they stand and move; all places are (n,), m."""

    def __init__(self, mechanics: Mechanics):
        self.mechanics = mechanics
        self.homed = False
        self.alarm: str | None = None
        """What the mechanics complain of, limit or switch; a controller clears it."""
        self.fault: FaultKind | None = None
        """The fault that has come over it, if one has."""
        self._place = np.array(mechanics.parked)
        # drives count from where they woke up
        self._zero = self._place.copy()
        self._legs: list[_Leg] = []
        self._homing = False
        self._leave = 0.0
        self._moves = 0
        self._failed = False
        self._fails_at = np.inf

    def true_place(self, now: float) -> Array:
        """Where the axes are on their rails."""
        self._advance(now)
        if not self._legs:
            return self._place.copy()
        return self._legs[0].at(min(now, self._fails_at))[0]

    def position(self, now: float) -> Array:
        """Where the drives believe they are."""
        step = self.mechanics.resolution
        return np.asarray(np.rint((self.true_place(now) - self._zero) / step) * step)

    def glimpse(self, now: float) -> Array:
        """As `position`, for another thread: it looks, and lets nothing happen."""
        legs, place, until = list(self._legs), self._place, min(now, self._fails_at)
        for leg in legs:
            place = leg.at(until)[0]
            if until < leg.began + leg.profile.duration:
                break
        step = self.mechanics.resolution
        return np.asarray(np.rint((place - self._zero) / step) * step)

    def doing(self, now: float) -> Doing:
        """What the axes are at. A stalled move goes on for ever."""
        self._advance(now)
        if not self._legs:
            return Doing.STANDING
        return Doing.HOMING if self._homing else Doing.MOVING

    def move(self, target: Array, speed: float, now: float) -> None:
        """Go to a place in the homed frame; the caller has seen that the axes stand."""
        self._advance(now)
        self._moves += 1
        start = self._legs[-1].at(np.inf)[0] if self._legs else self._place
        began = self._legs[-1].began + self._legs[-1].profile.duration if self._legs else now
        leg = self._leg(start, target + self._zero, speed, began)
        self._legs.append(leg)
        fault = self.mechanics.fault
        if fault.kind not in ("none", "no-switch") and self._moves == fault.move:
            self._fails_at = began + fault.share * leg.profile.duration

    def home(self, now: float, leave: float = 0.0) -> None:
        """Run to the switches, back off, creep to them again; there is zero.

        Args:
            now: s.
            leave: by how far they are left at the end, m.
        """
        self._advance(now)
        m = self.mechanics
        self.homed, self.alarm, self._homing, self._leave = False, None, True, leave
        broken = m.fault.kind == "no-switch"
        switches = np.array(m.lower) if broken else np.zeros_like(self._place)
        self._legs = []
        for place, speed in (
            (switches, m.homing_speed),
            (switches + m.pull_off, m.homing_speed),
            (switches, m.creep_speed),
            (switches + leave, m.homing_speed),
        ):
            start = self._legs[-1].at(np.inf)[0] if self._legs else self._place
            began = self._legs[-1].began + self._legs[-1].profile.duration if self._legs else now
            self._legs.append(self._leg(start, place, speed, began))
            if broken:
                break

    def brake(self, now: float) -> None:
        """Come to rest as soon as the mechanics allow; homing is given up."""
        self._advance(now)
        if not self._legs:
            return
        place, speed = self._legs[0].at(min(now, self._fails_at))
        if self.fault == "stall":
            self.fault, speed = None, 0.0
        profile = braking(speed, self.mechanics.acceleration)
        self._legs = [_Leg(place, self._legs[0].direction, profile, now)]
        self._fails_at = np.inf
        self._homing = False

    def cut(self, now: float) -> None:
        """Stop at once, as when the drives lose their current: the place is not to be trusted."""
        self.brake(now)
        if self._legs:
            self._place, self._legs, self.homed = self._legs[0].start, [], False

    def _leg(self, start: Array, end: Array, speed: float, began: float) -> _Leg:
        way = end - start
        length = float(np.linalg.norm(way))
        direction = way / length if length > 0 else np.zeros_like(way)
        return _Leg(start, direction, trapezoid(length, speed, self.mechanics.acceleration), began)

    def _advance(self, now: float) -> None:
        """Let everything happen that was to happen until now."""
        if not self._failed and now >= self._fails_at:
            self._fail()
        if self.fault == "stall":
            return
        while self._legs and now >= self._legs[0].began + self._legs[0].profile.duration:
            self._place = self._legs.pop(0).at(np.inf)[0]
            if not self._legs and self._homing:
                self._homing = False
                if self.mechanics.fault.kind == "no-switch":
                    self.alarm = "switch"
                else:
                    self.homed, self._zero = True, self._place - self._leave

    def _fail(self) -> None:
        self.fault, self._failed = self.mechanics.fault.kind, True
        if self.fault == "alarm":
            self._place = self._legs[0].at(self._fails_at)[0]
            self._legs, self._fails_at = [], np.inf
            self.alarm, self.homed = "limit", False
