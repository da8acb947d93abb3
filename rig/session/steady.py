"""The wall clock of a session, which never jumps: set once, then led by the steady clock."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rig.cameras.camera import Capture, moment_of

_STEP = 1e-3
"""s by which a session's time lies after the last stamp of an earlier run, at least."""


class SteadyClock:
    """Seconds since the epoch that go on evenly, whatever is done to the wall clock.

    A wall clock that is set back or forward in mid-session would make fresh frames stale, and
    stamps fall. The machine's steady clock is the same in all its processes.
    """

    def __init__(self, stamps: Sequence[float] = ()) -> None:
        """Read the wall clock once; time goes on after all ``stamps`` (s) that are there."""
        steady = time.monotonic()
        after = max(stamps, default=-float("inf")) + _STEP
        self._ahead = max(time.time(), after) - steady

    def now(self) -> float:
        """Return the session's time, s since the epoch."""
        return self._ahead + time.monotonic()

    def of(self, capture: Capture) -> float:
        """Return when a frame was taken, s since the epoch.

        Its own process has told its age; else it is found here, as soon after as may be.
        """
        moment = moment_of(capture.stamp) if capture.moment is None else capture.moment
        return self._ahead + moment
