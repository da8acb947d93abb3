"""Shows how a benchmark goes: a bar on a terminal, plain lines elsewhere; always on stderr."""

from __future__ import annotations

from rich.progress import TimeElapsedColumn

from depthba.verbs.progress import Bar


class BenchmarkProgress(Bar):
    """Told of every method that is dealt with."""

    def __init__(self) -> None:
        """Begin with nothing done."""
        super().__init__("benchmark", "", TimeElapsedColumn())
        self._last = ("", -1)

    def __call__(self, done: int, total: int, text: str) -> None:
        """Show that ``done`` of ``total`` methods are dealt with, and what runs."""
        if self.drawn or (text, done) != self._last:
            self.show(f"{done} of {total} runs, {text}", done, total)
        self._last = (text, done)
