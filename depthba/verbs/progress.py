"""Shows how work goes: a bar on a terminal, plain lines elsewhere; always on stderr."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn

from depthba.verbs.output import angle, length

if TYPE_CHECKING:
    from depthba.result import Iteration


SELDOM = 5.0
"""Seconds between plain lines of a count."""


class Bar:
    """A bar with a name in front and a few words behind; a line for each call without a terminal.

    Use it as a context manager, so that the terminal is whole again whatever happens.
    """

    def __init__(self, name: str, state: str = "", *columns: ProgressColumn) -> None:
        """``name`` stands in front of the bar and of every line, ``columns`` behind the words."""
        self._name = name
        self._console = Console(stderr=True, soft_wrap=True, highlight=False)
        self._bar: Progress | None = None
        if self._console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.description}", markup=False),
                BarColumn(bar_width=24),
                TextColumn("{task.fields[state]}", markup=False),
                *columns,
                console=self._console,
                transient=True,
            )
            self._task = self._bar.add_task(name, total=None, state=state)

    def __enter__(self) -> Self:
        """Start showing."""
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Take the bar away."""
        if self._bar is not None:
            self._bar.stop()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Leave the terminal to somebody else while the block lasts."""
        if self._bar is not None:
            self._bar.stop()
        try:
            yield
        finally:
            if self._bar is not None:
                self._bar.start()

    @property
    def drawn(self) -> bool:
        """Whether there is a terminal: lines may then come as often as they like."""
        return self._bar is not None

    def show(self, state: str, done: float, total: float | None) -> None:
        """Show what is being done, and how much of everything is; None: nobody knows."""
        if self._bar is None:
            self._console.print(f"{self._name}: {state}", markup=False)
        else:
            self._bar.update(self._task, total=total, completed=done, state=state)


class Counter(Bar):
    """A callback for work of known length: so many of so many."""

    def __init__(self, name: str, what: str) -> None:
        """``name`` stands in front of the bar and of every line; ``what`` is counted."""
        super().__init__(name, "", TimeElapsedColumn())
        self._what = what
        self._told = time.monotonic()

    def __call__(self, done: int, total: int) -> None:
        """Show how far it has come; without a terminal every few seconds, and at the end."""
        now = time.monotonic()
        if self.drawn or done == total or now - self._told > SELDOM:
            self._told = now
            self.show(f"{done} of {total} {self._what}s", done, total)


class RegistrationProgress(Bar):
    """A callback for `depthba.register` that shows level, iteration, cost and step."""

    def __init__(self, name: str = "registering") -> None:
        """``name`` stands in front of the bar and of every line."""
        super().__init__(name, "reading frames", TimeElapsedColumn())

    def __call__(self, iteration: Iteration) -> None:
        """Show one iteration."""
        # how many iterations a level takes is not known: the robust phase counts as its second half
        done = iteration.level + (0.5 if iteration.phase == "robust" else 0.0)
        self.say(_state(iteration), done / iteration.levels)

    def say(self, state: str, share: float = 1.0) -> None:
        """Show what is being done, and which share of everything is."""
        self.show(state, share, 1.0)


def _state(iteration: Iteration) -> str:
    step = f"step {length(iteration.step_t)}, {angle(iteration.step_r)}"
    return (
        f"level {iteration.level + 1}/{iteration.levels} ({length(iteration.spacing)}), "
        f"{iteration.phase}, iteration {iteration.index + 1}: "
        f"cost {iteration.cost:.6g}, {step if iteration.accepted else 'step refused'}, "
        f"sigma {length(iteration.sigma)}, {iteration.seconds:.1f} s"
    )
