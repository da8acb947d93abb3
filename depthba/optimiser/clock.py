"""Seconds per stage, and when to stop."""

from __future__ import annotations

import time
from dataclasses import dataclass, field


@dataclass
class Clock:
    """Runs from when it is made."""

    limit: float | None = None
    """Seconds after which no further iteration begins; None: no limit."""
    start: float = field(default_factory=time.perf_counter)
    last: float = field(default_factory=time.perf_counter)
    stages: dict[str, float] = field(default_factory=dict)

    def lap(self, stage: str) -> None:
        """Charge the time since the last call to a stage."""
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + now - self.last
        self.last = now

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return time.perf_counter() - self.start

    @property
    def over(self) -> bool:
        """Whether the limit has passed."""
        return self.limit is not None and self.elapsed > self.limit
