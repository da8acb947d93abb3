"""The interface of linear axes that carry a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Axis:
    """One axis and its soft limits."""

    name: str
    """As "x"."""
    lower: float
    upper: float
    """Between these it may go, m."""
    speed: float
    """At most, m/s."""


@dataclass(frozen=True, eq=False)
class AxesState:
    """One instant of all axes."""

    stamp: float
    """Host clock, s since the epoch, of the answer."""
    position: Array
    """(n,) m."""
    homed: bool
    moving: bool
    alarm: str | None
    """What the controller complains of, in its words; None: nothing."""


class Axes(Protocol):
    """Linear axes. Raises `rig.errors.AxesError`, nothing else.

    `move_to` and `home` return once the axes stand where they were sent, checked by the position
    that they report. No target leaves for the controller before its length, finiteness and limits
    were checked, and none at all before the axes are homed.
    """

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Names and limits, in the order of every position (n,)."""

    def connect(self) -> None:
        """Reach the controller. Ends in time whatever is there."""

    def home(self) -> AxesState:
        """Find the reference switches."""

    def status(self) -> AxesState:
        """The newest instant."""

    def position(self) -> Array:
        """(n,) m, now."""

    def move_to(self, target: ArrayLike, *, speed: float) -> AxesState:
        """Go to a position (n,), m, along a straight line, at `speed` m/s."""

    def stop(self) -> None:
        """Brake now, and end the move that is under way in another thread. Never raises."""

    def disconnect(self) -> None:
        """Let go of the controller. Safe to call twice, and after a failure."""
