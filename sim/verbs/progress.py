"""Shows how rendering goes: a bar on a terminal, a few plain lines elsewhere; always on stderr."""

from __future__ import annotations

import time

from rich.progress import TimeElapsedColumn, TimeRemainingColumn

from depthba.verbs.progress import Bar

_EVERY = 5.0
"""Seconds between plain lines."""


class FrameProgress(Bar):
    """A callback for `sim.generate`: the frames of one dataset."""

    def __init__(self, name: str) -> None:
        """`name` stands in front of the bar and of every line."""
        super().__init__(name, "", TimeRemainingColumn())
        self._rarely = _Rarely()

    def __call__(self, done: int, total: int, text: str) -> None:
        """Show that `done` of `total` frames are committed; 0: nobody knows how many there are."""
        if self.drawn or self._rarely(done == total):
            frames = f", {done} of {total} frames" if total else ""
            self.show(f"{text}{frames}", done, total or None)


class BatchProgress(Bar):
    """A callback for `sim.batch.generate_many`: datasets, how fast they come, and the time left."""

    def __init__(self, name: str) -> None:
        """`name` stands in front of the bar and of every line."""
        super().__init__(name, "looking what is there", TimeElapsedColumn())
        self._rarely = _Rarely()
        self._first: tuple[float, int] | None = None

    def __call__(self, done: int, total: int, text: str) -> None:
        """Show that `done` of `total` datasets are dealt with."""
        now = time.monotonic()
        # Those that were there already tell nothing about the pace.
        self._first = self._first or (now, done)
        state = f"{text}, {done} of {total} datasets"
        made, seconds = done - self._first[1], now - self._first[0]
        if made and seconds > 0.0:
            state += f", {_rate(made / seconds)}"
            if done < total:
                state += f", {duration((total - done) * seconds / made)} left"
        if self.drawn or self._rarely(done == total):
            self.show(state, done, total)


class _Rarely:
    """Says whether a plain line is due."""

    def __init__(self) -> None:
        self._next = 0.0

    def __call__(self, always: bool) -> bool:
        now = time.monotonic()
        if not always and now < self._next:
            return False
        self._next = now + _EVERY
        return True


def duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    if seconds < 6000.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"


def _rate(per_second: float) -> str:
    if per_second >= 1.0:
        return f"{per_second:.1f} a second"
    if per_second * 60.0 >= 1.0:
        return f"{per_second * 60.0:.1f} a minute"
    return f"{per_second * 3600.0:.1f} an hour"
