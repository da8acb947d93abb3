"""Moves under watch: checked before, followed until the axes stand, braked whatever goes wrong."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.axes.axes import AxesState, Axis
from rig.axes.limits import check_axes, check_speed, check_target, described
from rig.errors import AxesError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Patience:
    """How long a move is watched, and when it counts as arrived."""

    tolerance: float = 1e-4
    """Axes within this of their target have arrived, m; above the controller's resolution."""
    stall: float = 1.0
    """Axes that get no nearer by `tolerance` for so long are stuck, s."""
    settle: float = 0.5
    """Axes that say they stand, but away from their target, for so long will not come, s."""
    poll: float = 0.02
    """Between two looks, s."""


def watch_move(
    read: Callable[[], AxesState],
    axes: Sequence[Axis],
    target: Array,
    patience: Patience,
    interrupted: Callable[[], bool],
    who: str,
) -> AxesState:
    """Return the state once the axes stand at `target` (n,), m.

    Args:
        read: asks the controller; its AxesError passes.
        axes: for their names.
        target: where they were sent.
        patience: what counts as arrived, and as stuck.
        interrupted: whether `stop` was called since the move began.
        who: the controller, with which an error begins.

    Raises:
        AxesError: alarm, homing lost, stop, a stall, or axes that stand elsewhere.
    """
    nearest = np.inf
    progress = stood = time.monotonic()
    while True:
        state = read()
        now = time.monotonic()
        if interrupted():
            raise AxesError(f"{who}: stopped on request at {described(axes, state.position)}")
        if state.alarm is not None:
            raise AxesError(
                f"{who}: alarm during the move: {state.alarm}, at {described(axes, state.position)}"
            )
        if not state.homed:
            raise AxesError(
                f"{who}: the axes lost their reference during the move; home them again"
            )
        away = float(np.abs(state.position - target).max())
        if away <= patience.tolerance and not state.moving:
            return state
        if away < nearest - patience.tolerance:
            nearest, progress = away, now
        if state.moving:
            stood = now
        where = f"{described(axes, state.position)}, expected {described(axes, target)}"
        if now - progress > patience.stall:
            raise AxesError(
                f"{who}: the axes are stuck: no nearer for {patience.stall:g} s at {where}"
            )
        if now - stood > patience.settle:
            raise AxesError(f"{who}: the axes did not arrive: they stand at {where}")
        time.sleep(patience.poll)


@contextmanager
def braked_on_failure(stop: Callable[[], None]) -> Iterator[None]:
    """Brake when what is guarded ends in an error, Ctrl-C too: nothing moves on unwatched."""
    try:
        yield
    except BaseException:
        stop()
        raise


class WatchedAxes(ABC):
    """What every gantry does alike, whatever its controller speaks; see `rig.axes.axes.Axes`."""

    def __init__(self, axes: tuple[Axis, ...], patience: Patience, who: str):
        """AxesError for axes that make no sense. `who` is for messages."""
        check_axes(axes)
        self._axes, self._patience, self._who = axes, patience, who
        self._stops = 0
        """How often `stop` was called: what began before a stop must not go on after it."""

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Names and limits."""
        return self._axes

    def position(self) -> Array:
        """(n,) m, now."""
        return self.status().position

    def move_to(self, target: ArrayLike, *, speed: float) -> AxesState:
        """Go to a position (n,), m, along a straight line, at `speed` m/s."""
        before = self._stops
        position = check_target(self._axes, target)
        check_speed(self._axes, speed)
        state = self._awake()
        if not state.homed:
            why = f" ({state.alarm})" if state.alarm is not None else ""
            raise AxesError(
                f"{self._who}: the axes are not homed{why}, expected home() before a move"
            )
        if state.alarm is not None:
            raise AxesError(f"{self._who}: {state.alarm}; see to it, then home the axes")
        try:
            with braked_on_failure(self.stop):
                self._start(position, speed, before)
                return watch_move(
                    self.status,
                    self._axes,
                    position,
                    self._patience,
                    lambda: self._stops != before,
                    self._who,
                )
        except AxesError:
            self._end_motion()
            raise

    def _refuse_stopped(self, before: int, when: str) -> None:
        """AxesError if a stop came since `_stops` was `before`."""
        if self._stops != before:
            raise AxesError(f"{self._who}: stopped on request {when}")

    @abstractmethod
    def status(self) -> AxesState:
        """The newest instant."""

    @abstractmethod
    def stop(self) -> None:
        """Brake now, and end the move that is under way in another thread. Never raises."""

    @abstractmethod
    def _start(self, position: Array, speed: float, before: int) -> None:
        """Send a move to (n,), m, unless a stop came since `_stops` was `before`."""

    def _awake(self) -> AxesState:
        """The newest instant, after what an earlier stop has left was undone."""
        return self.status()

    def _end_motion(self) -> None:
        """Do what must be done after a move that failed and was braked."""
        return
