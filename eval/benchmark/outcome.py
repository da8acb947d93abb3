"""What one method did on one dataset, as its folder keeps it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from depthba import durable
from depthba.documents import parse_json
from eval.metrics import Metric

FILE = "outcome.json"
POSES = "poses.txt"
Status = Literal["done", "failed", "crashed", "time", "memory", "missing", "no dataset"]
"""``failed``: the method says that it found no answer; ``crashed``: its process ended otherwise;
``time``, ``memory``: it was stopped at a limit; ``missing``: a package is not installed."""


@dataclass(frozen=True)
class Outcome:
    """One method on one dataset."""

    key: str
    """Names everything that the outcome depends on; another key makes it stale."""
    dataset: str
    """Name of the dataset in the report; one folder of the benchmark."""
    group: str
    """Datasets of one group are one scene at several seeds."""
    seed: int | None
    method: str
    status: Status
    reason: str = ""
    """One line; empty for what is done without a remark."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """By stage."""
    memory: float | None = None
    """Most memory that the process held, bytes."""
    iterations: int | None = None
    notes: tuple[str, ...] = ()
    metrics: tuple[Metric, ...] = ()
    limits: Mapping[str, float] = field(default_factory=dict)
    """Under which it ran: ``seconds`` and ``bytes``."""
    varied: tuple[str, float] | None = None
    """Name and value of what a study varies."""

    @property
    def total(self) -> float:
        """Seconds of all stages."""
        return float(sum(self.seconds.values()))

    def value(self, name: str) -> float:
        """Return a metric's value; NaN where there is none."""
        return next((m.value for m in self.metrics if m.name == name), float("nan"))

    def as_json(self) -> dict[str, Any]:
        """Return what outcome.json holds: metres, radians, seconds, bytes; unknown is null."""
        return {
            "format": "depthba-outcome",
            "version": 1,
            "key": self.key,
            "dataset": self.dataset,
            "group": self.group,
            "seed": self.seed,
            "method": self.method,
            "status": self.status,
            "reason": self.reason,
            "seconds": {k: float(v) for k, v in self.seconds.items()},
            "total_seconds": self.total,
            "memory_bytes": self.memory,
            "iterations": self.iterations,
            "notes": list(self.notes),
            "metrics": {
                m.name: {
                    "value": m.value if np.isfinite(m.value) else None,
                    "unit": m.unit,
                    "better": m.better,
                }
                for m in self.metrics
            },
            "limits": dict(self.limits),
            "varied": None if self.varied is None else list(self.varied),
        }

    @classmethod
    def of_json(cls, raw: Mapping[str, Any]) -> Outcome:
        """Undo `as_json`; KeyError, TypeError or ValueError where it is none."""
        if raw["format"] != "depthba-outcome" or raw["version"] != 1:
            raise ValueError("not an outcome of this version")
        varied = raw["varied"]
        return cls(
            key=str(raw["key"]),
            dataset=str(raw["dataset"]),
            group=str(raw["group"]),
            seed=raw["seed"],
            method=str(raw["method"]),
            status=raw["status"],
            reason=str(raw["reason"]),
            seconds=dict(raw["seconds"]),
            memory=raw["memory_bytes"],
            iterations=raw["iterations"],
            notes=tuple(raw["notes"]),
            metrics=tuple(
                Metric(name, m["unit"], m["better"], _number(m["value"]))
                for name, m in raw["metrics"].items()
            ),
            limits=dict(raw["limits"]),
            varied=None if varied is None else (str(varied[0]), float(varied[1])),
        )

    def write(self, folder: Path) -> None:
        """Put outcome.json into the folder, whole."""
        durable.write_json(folder / FILE, self.as_json())


def read(folder: Path) -> Outcome | None:
    """Return the outcome that a folder holds; None where there is none that can be read."""
    try:
        return Outcome.of_json(parse_json((folder / FILE).read_text(encoding="utf-8")))
    except (OSError, LookupError, TypeError, ValueError, AttributeError, OverflowError):
        return None


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)
