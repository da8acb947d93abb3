"""Shows how rendering goes: a bar on a terminal, a few plain lines elsewhere; always on stderr."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

_EVERY = 5.0
"""Seconds between plain lines."""


class FrameProgress:
    """A callback for `sim.generate`; a context manager, so that the terminal is left whole."""

    def __init__(self, name: str) -> None:
        """`name` stands in front of the bar and of every line."""
        self._name = name
        self._console = Console(stderr=True, soft_wrap=True, highlight=False)
        self._bar: Progress | None = None
        self._said = -1.0
        if self._console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=24),
                MofNCompleteColumn(),
                TextColumn("{task.fields[state]}"),
                TimeRemainingColumn(),
                console=self._console,
                transient=True,
            )
            self._task = self._bar.add_task(name, total=None, state="")

    def __enter__(self) -> FrameProgress:
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

    def __call__(self, done: int, total: int, text: str) -> None:
        """Show that `done` of `total` frames are committed."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=total, state=text)
            return
        now = time.monotonic()
        if done == total or self._said < 0.0 or now - self._said > _EVERY:
            self._said = now
            self._console.print(f"{self._name}: {text}, {done} of {total} frames", markup=False)
