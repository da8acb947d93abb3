"""Many outcomes in few numbers: medians and spread over seeds, and who is first.

A seed on which a method found nothing counts as an infinite error: leaving it out would praise a
method for failing where it is hard.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eval.benchmark.outcome import Outcome
from eval.methods import entry, in_order


@dataclass(frozen=True)
class Cell:
    """One metric of one method over the seeds of a group."""

    median: float
    """Infinite where more than half of the seeds failed; NaN where nothing was measured."""
    low: float
    high: float
    """Least and largest of the seeds that were done."""
    done: int
    count: int
    """Seeds that were done, and those that there are."""


@dataclass(frozen=True)
class Row:
    """One metric of one group, method by method."""

    group: str
    metric: str
    cells: dict[str, Cell]
    best: str | None
    """Among the methods that are ranked; None where nobody has a figure."""
    second: str | None


def groups(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the groups in their order."""
    return list(dict.fromkeys(o.group for o in outcomes))


def methods(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the methods in the order of the tables."""
    return in_order(o.method for o in outcomes)


def cell(outcomes: Sequence[Outcome], group: str, method: str, metric: str) -> Cell:
    """Summarise a metric, ``total_seconds`` and ``memory`` among them."""
    mine = [o for o in outcomes if o.group == group and o.method == method]
    values = np.array([_value(o, metric) for o in mine])
    done = np.array([o.status == "done" for o in mine], dtype=bool)
    known = values[done & np.isfinite(values)]
    if not len(known):
        median = float("inf") if len(mine) and not done.any() else float("nan")
        return Cell(median, float("nan"), float("nan"), int(done.sum()), len(mine))
    ranked = np.where(done, values, np.inf)
    ranked = ranked[~np.isnan(ranked)]
    return Cell(
        median=_median(ranked),
        low=float(known.min()),
        high=float(known.max()),
        done=int(done.sum()),
        count=len(mine),
    )


def row(outcomes: Sequence[Outcome], group: str, metric: str) -> Row:
    """Summarise a metric of a group for all methods, and rank them."""
    cells = {name: cell(outcomes, group, name, metric) for name in methods(outcomes)}
    ranked = sorted(
        (name for name in cells if entry(name).ranked and np.isfinite(cells[name].median)),
        key=lambda name: cells[name].median,
    )
    best, second = [*ranked, None, None][:2]
    return Row(group, metric, cells, best, second)


def _value(outcome: Outcome, metric: str) -> float:
    if metric == "total_seconds":
        return outcome.total
    if metric == "memory":
        return float("nan") if outcome.memory is None else outcome.memory
    return outcome.value(metric)


def _median(values: np.ndarray) -> float:
    """Return the median; of an even count with infinities the upper of the two, not NaN."""
    ordered = np.sort(values)
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return float(high) if np.isinf(high) else float(0.5 * (low + high))
