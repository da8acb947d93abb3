"""Shows how a registration goes: a bar on a terminal, plain lines elsewhere; always on stderr."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from depthba.result import Iteration
from depthba.verbs.output import angle, length


class RegistrationProgress:
    """A callback for `depthba.register` that shows level, iteration, cost and step.

    Use it as a context manager, so that the terminal is whole again whatever happens.
    """

    def __init__(self, name: str = "registering") -> None:
        """``name`` stands in front of the bar and of every line."""
        self._name = name
        self._console = Console(stderr=True, soft_wrap=True, highlight=False)
        self._bar: Progress | None = None
        if self._console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=24),
                TextColumn("{task.fields[state]}"),
                TimeElapsedColumn(),
                console=self._console,
                transient=True,
            )
            self._task = self._bar.add_task(name, total=None, state="reading frames")

    def __enter__(self) -> RegistrationProgress:
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

    def __call__(self, iteration: Iteration) -> None:
        """Show one iteration."""
        # how many iterations a level takes is not known: the robust phase counts as its second half
        done = iteration.level + (0.5 if iteration.phase == "robust" else 0.0)
        self.say(_state(iteration), done / iteration.levels)

    def say(self, state: str, share: float = 1.0) -> None:
        """Show what is being done, and which share of everything is."""
        if self._bar is None:
            self._console.print(f"{self._name}: {state}", markup=False)
        else:
            self._bar.update(self._task, total=1.0, completed=share, state=state)


def _state(iteration: Iteration) -> str:
    step = f"step {length(iteration.step_t)}, {angle(iteration.step_r)}"
    return (
        f"level {iteration.level + 1}/{iteration.levels} ({length(iteration.spacing)}), "
        f"{iteration.phase}, iteration {iteration.index + 1}: "
        f"cost {iteration.cost:.6g}, {step if iteration.accepted else 'step refused'}, "
        f"sigma {length(iteration.sigma)}, {iteration.seconds:.1f} s"
    )
