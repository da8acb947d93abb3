"""Where the arm is on its way: speed grows and falls with the acceleration asked for.

A way is a path of joints over a length, m or rad; how far along it the arm is follows a trapezoid
of speed, all joints together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from depthba.straight import Line

Array = NDArray[np.float64]

SPEED_LIMITS = tuple(math.radians(v) for v in (120, 120, 180, 180, 180, 180))
"""Of the UR16e's joints, rad/s (data sheet)."""


class Path(Protocol):
    """Joints over a length."""

    @property
    def length(self) -> float:
        """Of the whole path, m or rad."""

    @property
    def fastest(self) -> float:
        """The speed along it, m/s or rad/s, that no joint's speed limit is broken at."""

    def at(self, s: float) -> tuple[Array, Array]:
        """The joints (n,), rad, and their derivative by the length, `s` along the path."""


class JointPath:
    """Straight in the joints; the length is the way of the joint that turns furthest."""

    def __init__(self, start: Array, goal: Array) -> None:
        """From joints (n,) to joints (n,), rad."""
        self._start, self._goal = start.copy(), goal.copy()
        self.length = float(np.abs(goal - start).max())
        self._slope = (goal - start) / max(self.length, 1e-300)
        self.fastest = _fastest(self._slope[None])

    def at(self, s: float) -> tuple[Array, Array]:
        """See `Path.at`; the goal itself at the end, to the last bit."""
        if s >= self.length:
            return self._goal, self._slope
        return self._start + s * self._slope, self._slope


class LinePath:
    """A straight line of the flange; a turn of one radian counts as a metre."""

    def __init__(self, line: Line, goal: Array | None = None) -> None:
        """`goal`: joints (n,) that are the end of the line to the last bit; None: the line's."""
        self._goal = line.joints[-1] if goal is None else goal.copy()
        self.length = max(line.length, line.angle)
        knots = np.linspace(0.0, max(self.length, 1e-9), len(line.joints))
        self._spline = CubicSpline(knots, line.joints)
        self.fastest = _fastest(self._spline(knots, 1))

    def at(self, s: float) -> tuple[Array, Array]:
        """See `Path.at`."""
        if s >= self.length:
            return self._goal, self._spline(self.length, 1)
        return self._spline(s), self._spline(s, 1)


def _fastest(slopes: Array) -> float:
    """From derivatives of the joints by the length (k, n)."""
    steepest = np.abs(slopes).max(axis=0)
    return float(np.min(SPEED_LIMITS / np.maximum(steepest, 1e-300)))


@dataclass
class Motion:
    """A way being gone: at rest at its start, at rest at its end."""

    path: Path
    speed: float
    acceleration: float
    time: float = 0.0
    """Since the start, s."""
    _braking: tuple[float, float, float] | None = field(default=None, repr=False)
    """Since when, from where along the path, at what speed."""

    def __post_init__(self) -> None:
        """Plan the trapezoid."""
        length = self.path.length
        ramp = min(self.speed / self.acceleration, math.sqrt(length / self.acceleration))
        ramp = min(ramp, self.path.fastest / self.acceleration)
        self._ramp, self._top = ramp, ramp * self.acceleration
        self._end = length / self._top + ramp if length > 0.0 else 0.0

    def advance(self, dt: float) -> tuple[Array, Array, bool]:
        """Joints (n,), rad, and their speeds (n,), rad/s, `dt` s later; and whether it is over."""
        self.time += dt
        s, v, over = self._along()
        q, slope = self.path.at(s)
        return q, np.zeros_like(q) if over else v * slope, over

    def brake(self, deceleration: float) -> None:
        """Stop on the path as soon as `deceleration` allows; never later than it would anyway."""
        s, v, _ = self._along()
        if self._braking is None and v > 0.0:
            self._braking = self.time, s, v
            self.acceleration = max(deceleration, self.acceleration)

    @property
    def share(self) -> float:
        """How much of the way is gone, 0 to 1."""
        return min(self._along()[0] / max(self.path.length, 1e-300), 1.0)

    def _along(self) -> tuple[float, float, bool]:
        """How far, how fast, and whether it is over."""
        a, t = self.acceleration, self.time
        if self._braking is not None:
            since, s, v = self._braking
            t -= since
            if t >= v / a:
                return s + 0.5 * v * v / a, 0.0, True
            return s + v * t - 0.5 * a * t * t, v - a * t, False
        left = self._end - t
        if left <= 0.0:
            return self.path.length, 0.0, True
        if t < self._ramp:
            return 0.5 * a * t * t, a * t, False
        if left < self._ramp:
            return self.path.length - 0.5 * a * left * left, a * left, False
        return self._top * (t - 0.5 * self._ramp), self._top, False
