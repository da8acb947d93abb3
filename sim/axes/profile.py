"""Distance over time of a move whose acceleration is limited."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Profile:
    """Pieces of constant acceleration, one after the other; then it stands."""

    speed: float
    """At the beginning, m/s."""
    pieces: tuple[tuple[float, float], ...]
    """Duration, s, and acceleration, m/s^2, of each."""

    @property
    def duration(self) -> float:
        """Until it stands, s."""
        return sum(duration for duration, _ in self.pieces)

    def at(self, time: float) -> tuple[float, float]:
        """Return the distance covered, m, and the speed, m/s, `time` s after the beginning."""
        distance, speed = 0.0, self.speed
        for duration, acceleration in self.pieces:
            t = min(max(time, 0.0), duration)
            distance += speed * t + acceleration * t * t / 2
            speed += acceleration * t
            if time < duration:
                return distance, speed
            time -= duration
        return distance, 0.0


def trapezoid(length: float, speed: float, acceleration: float) -> Profile:
    """Return the fastest profile from rest to rest over `length` m; a triangle where it is short.

    Args:
        length: m, 0 or more.
        speed: at most, m/s.
        acceleration: of speeding up and of braking, m/s^2.
    """
    peak = min(speed, math.sqrt(length * acceleration))
    if peak <= 0:
        return Profile(0.0, ())
    ramp = peak / acceleration
    cruise = max(0.0, length / peak - ramp)
    return Profile(0.0, ((ramp, acceleration), (cruise, 0.0), (ramp, -acceleration)))


def braking(speed: float, acceleration: float) -> Profile:
    """Return the profile that comes from `speed`, m/s, to rest as soon as can be."""
    if speed <= 0:
        return Profile(0.0, ())
    return Profile(speed, ((speed / acceleration, -acceleration),))
