"""Watches a move until the axes stand where they were sent, or says why they do not."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.axes.axes import AxesState, Axis
from rig.axes.limits import described
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
