"""Where the datasets of a batch are made: in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from typing import Any, Protocol

from depthba.errors import DepthbaError, MissingPackage, OptionError

Work = Callable[..., str | None]
"""What a worker does: a function of a module. It returns the line of an error, None without one."""

_THREADS = tuple(
    f"{library}_THREADS"
    for library in ("OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "NUMBA_NUM", "VECLIB_MAXIMUM")
)
"""Variables that say how many threads a numerical library starts; it reads them when imported."""
_CONNECT = 15
"""Seconds in which a scheduler must answer."""


class Workers(Protocol):
    """Takes work, each piece for one worker."""

    def state(self) -> str:
        """What goes on, in a word or two."""

    def room(self) -> int:
        """How many more pieces of work it takes now."""

    def submit(self, work: Work, *arguments: object) -> Future[str | None]:
        """Hand over one piece of work."""

    def outcome(self, future: Future[str | None]) -> str | None:
        """The line of the error of work that is done, None without one.

        A worker that was killed is an error of its work alone, and another takes its place.
        """

    def stop(self, now: bool) -> None:
        """Send the workers home; `now`: without waiting for what they are doing."""


def cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class LocalWorkers:
    """Processes of this machine, with one thread each for the linear algebra.

    Each has an executor of its own, so that where one is killed the others go on. All end with this
    process, however that ends: each holds one end of a pipe that then breaks.
    """

    def __init__(self, count: int) -> None:
        """`count` processes, started when there is work for them."""
        self._context = multiprocessing.get_context("spawn")
        self._watched, self._lifeline = self._context.Pipe(duplex=False)
        self._idle = [self._executor() for _ in range(count)]
        self._busy: dict[Future[str | None], ProcessPoolExecutor] = {}

    def state(self) -> str:
        """What goes on."""
        return "generating"

    def room(self) -> int:
        """How many processes have nothing to do."""
        return len(self._idle)

    def submit(self, work: Work, *arguments: object) -> Future[str | None]:
        """Hand over one piece of work."""
        executor = self._idle.pop()
        with _start_of_a_worker():
            future = executor.submit(work, *arguments)
        self._busy[future] = executor
        return future

    def outcome(self, future: Future[str | None]) -> str | None:
        """The line of the error of work that is done, None without one."""
        executor = self._busy.pop(future)
        try:
            error = future.result()
        except BrokenProcessPool:
            executor.shutdown(wait=False)
            executor = self._executor()
            error = "its process was killed, or crashed"
        self._idle.append(executor)
        return error

    def stop(self, now: bool) -> None:
        """Send the workers home; `now`: without waiting for what they are doing."""
        if now:
            self._lifeline.close()
        for executor in (*self._idle, *self._busy.values()):
            executor.shutdown(wait=True, cancel_futures=True)
        self._lifeline.close()
        self._watched.close()

    def _executor(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, self._context, _begin, (self._watched,))


@contextlib.contextmanager
def _start_of_a_worker() -> Iterator[None]:
    """What a process inherits: one thread for each library, and deafness to Ctrl-C.

    The terminal sends Ctrl-C to all processes; the first one then ends the others.
    """
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    blocked: set[int] | None = None
    if hasattr(signal, "pthread_sigmask"):
        blocked = set(signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if blocked is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _begin(watched: Connection) -> None:
    """First thing in a worker: end at once when the other end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        with contextlib.suppress(OSError):
            watched.poll(None)
        os._exit(1)  # what was committed of a dataset is whole, and the rest does not count

    threading.Thread(target=watch, daemon=True).start()


class ClusterWorkers:
    """The workers of a Dask scheduler; they need this package and the same file system."""

    def __init__(self, address: str) -> None:
        """MissingPackage: no distributed. OptionError: nothing answers at `address`."""
        try:
            import distributed
        except ImportError as error:
            raise MissingPackage(
                "--scheduler needs distributed, which is not installed:"
                " pip install 'depthba[distributed]'"
            ) from error
        self._address = address
        # What befalls a connection is told in one line, not in tracebacks.
        self._log = logging.getLogger("distributed.client")
        self._level = self._log.level
        self._log.setLevel(logging.CRITICAL + 1)
        try:
            self._client: Any = distributed.Client(
                address, timeout=_CONNECT, set_as_default=False, name="depthba"
            )
        except (OSError, ValueError, TypeError) as error:
            self._log.setLevel(self._level)
            reason = " ".join(str(error).split())
            raise OptionError(
                f"scheduler {address!r}: {reason}; expected the address of a Dask scheduler,"
                " such as tcp://127.0.0.1:8786"
            ) from error
        # Each call is work of its own, even where the arguments are those of an earlier one.
        self._executor = self._client.get_executor(pure=False)
        self._running = 0

    def state(self) -> str:
        """What goes on, or that nobody is there to do it."""
        return "generating" if self._threads() else "waiting for workers"

    def room(self) -> int:
        """Enough to keep every worker busy, also one that has just come."""
        return max(2 * self._threads(), 8) - self._running

    def submit(self, work: Work, *arguments: object) -> Future[str | None]:
        """Hand over one piece of work."""
        future: Future[str | None] = self._asked(self._executor.submit, work, *arguments)
        self._running += 1
        return future

    def outcome(self, future: Future[str | None]) -> str | None:
        """The line of the error of work that is done, None without one."""
        self._running -= 1
        try:
            return future.result()
        except CancelledError as error:
            raise self._gone() from error
        except Exception as error:  # a worker that was killed, or lacks a package
            return f"{type(error).__name__}: {' '.join(str(error).split())}"

    def stop(self, now: bool) -> None:
        """Give back what is not begun, and leave; the workers belong to others."""
        # A cluster that is gone throws in many ways, and gives back nothing.
        with contextlib.suppress(Exception):
            self._executor.shutdown(wait=False)
        self._client.close()
        self._log.setLevel(self._level)

    def _threads(self) -> int:
        return sum(self._asked(self._client.nthreads).values())

    def _asked(self, question: Callable[..., Any], *arguments: object) -> Any:
        try:
            return question(*arguments)
        except Exception as error:
            if self._client.status == "running":
                raise
            raise self._gone() from error

    def _gone(self) -> DepthbaError:
        return DepthbaError(
            f"scheduler {self._address}: has gone; what is finished stays, give the command again"
        )
