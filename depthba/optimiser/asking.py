"""Whether to stop, asked wherever work takes long.

Who may cancel is known to the thread: passing it through every function that loops over frames
would be in the way of what they do.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar

from depthba.errors import Cancelled

_asked: ContextVar[Callable[[], bool] | None] = ContextVar("_asked", default=None)


def look() -> None:
    """Raise :class:`Cancelled` if the caller of the registration wants it to stop."""
    asked = _asked.get()
    if asked is not None and asked():
        raise Cancelled("the registration was cancelled")


def listen(cancel: Callable[[], bool] | None) -> None:
    """Ask this from now on, in the present thread: for threads that serve one registration."""
    _asked.set(cancel)


@contextlib.contextmanager
def listening(cancel: Callable[[], bool] | None) -> Iterator[None]:
    """Ask this while in the context."""
    before = _asked.set(cancel)
    try:
        yield
    finally:
        _asked.reset(before)
