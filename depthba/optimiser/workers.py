"""A few threads over which work is dealt out, and the memory they work in."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from depthba.errors import Cancelled
from depthba.optimiser.asking import listen
from depthba.optimiser.problem import Problem

T = TypeVar("T")

# Rows of a grid below which a second thread costs more than it saves.
LEAST_ROWS = 64
# Runs of frames that are summed apart: each needs a map's memory.
SHARES = 4


@dataclass(frozen=True)
class Scratch:
    """What a pass over the points needs only while it runs."""

    nodes: NDArray[np.float64]
    """(ny, nx, 3), heights and gradients."""
    totals: NDArray[np.float64]
    """(parts, ny, nx, 6), stencil and gradient of the map by run of frames."""


class Workers:
    """A few threads. Sums are formed in a fixed order, whatever finishes first.

    One pass at a time: the scratch memory is shared.
    """

    def __init__(self, threads: int, cancel: Callable[[], bool] | None = None) -> None:
        """Start the threads.

        Args:
            threads: how many.
            cancel: asked before every piece of work; when True, it raises :class:`Cancelled`.
        """
        self.threads = threads
        self._cancel = cancel
        self._pool = (
            ThreadPoolExecutor(threads, initializer=listen, initargs=(cancel,))
            if threads > 1
            else None
        )
        self._scratch: Scratch | None = None

    def map(self, function: Callable[..., T], *items: Iterable[Any]) -> list[T]:
        """Return the results in the order of the items."""
        if self._cancel is not None:
            function = self._stoppable(function, self._cancel)
        if self._pool is None:
            return list(map(function, *items))
        return list(self._pool.map(function, *items))

    def over(self, count: int, kernel: Callable[..., None], *arguments: Any) -> None:
        """Let a kernel go over ``count`` things, some in each thread.

        It is called with the first and the one past the last, then the arguments.
        """
        self.map(lambda band: kernel(*band, *arguments), self.bands(count))

    @staticmethod
    def _stoppable(function: Callable[..., T], cancel: Callable[[], bool]) -> Callable[..., T]:
        def guarded(*arguments: Any) -> T:
            if cancel():
                raise Cancelled("the registration was cancelled")
            return function(*arguments)

        return guarded

    def close(self) -> None:
        """End the threads and let go of the memory."""
        self._scratch = None
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)

    @staticmethod
    def shares(problem: Problem) -> list[range]:
        """Deal the frames out in runs of about equal numbers of points.

        As many whatever the number of threads: so the sums are the same to the last bit.
        """
        sizes = np.array([len(f) for f in problem.frames], dtype=float)
        ends = np.cumsum(sizes) - sizes / 2
        share = np.minimum((ends / max(sizes.sum(), 1) * SHARES).astype(int), SHARES - 1)
        return [
            range(int(np.flatnonzero(share == k)[0]), int(np.flatnonzero(share == k)[-1]) + 1)
            for k in range(SHARES)
            if (share == k).any()
        ]

    def bands(self, rows: int) -> list[tuple[int, int]]:
        """Deal the rows of a grid out: first row and the one past the last.

        As many whatever the number of threads, as with :meth:`shares`.
        """
        count = max(1, min(SHARES, rows // LEAST_ROWS))
        ends = [rows * k // count for k in range(count + 1)]
        return list(pairwise(ends))

    def scratch(self, shape: tuple[int, int], parts: int) -> Scratch:
        """Return memory for a pass over a grid of ``shape``; its values are not set."""
        held = self._scratch
        if held is None or held.nodes.shape[:2] != shape or len(held.totals) != parts:
            held = Scratch(np.empty((*shape, 3)), np.empty((parts, *shape, 6)))
            self._scratch = held
        return held
