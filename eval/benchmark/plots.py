"""The plots of a benchmark: errors with their spread, time by stage, and the studies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eval.benchmark.outcome import Outcome
from eval.benchmark.summary import Cell, cell, groups, methods
from eval.methods import METHODS, entry

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GOOD = {"start": 3.0}
"""A start counts as a success where the error is below this many times the method's best median."""
AXES = {
    "start": "start poses off by (mm, and twice that in mrad)",
    "noise": "depth noise, factor on the sensor's",
    "frames": "frames, the first ones of the capture",
    "overlap": "frames that cover the same ground",
    "resolution": "width of the images (pixels)",
}
SCALES = {"start": 10.0}
"""From the value of a study to its axis; 1 where nothing is said."""


def colour(method: str) -> str:
    """Return a method's colour: ours stand out, the others keep theirs in every plot."""
    if method == "depthba":
        return "#d62728"
    if method == "depthba-paper":
        return "#ff9896"
    if method == "initial":
        return "#999999"
    theirs = ("#1f77b4", "#17becf", "#2ca02c", "#98df8a", "#9467bd", "#8c564b", "#c49c94",
              "#bcbd22", "#e377c2", "#7f7f7f")  # fmt: skip
    others = [m for m in METHODS if m not in ("depthba", "depthba-paper", "initial")]
    at = others.index(method) if method in others else sum(map(ord, method))
    return theirs[at % len(theirs)]


def draw_all(outcomes: Sequence[Outcome], folder: Path) -> list[tuple[str, Path]]:
    """Draw what the outcomes give; return titles and PNG files."""
    folder.mkdir(parents=True, exist_ok=True)
    plain = [o for o in outcomes if o.varied is None]
    studies = list(dict.fromkeys(o.varied[0] for o in outcomes if o.varied is not None))
    asked: list[tuple[str, str, Callable[[], Figure | None]]] = [
        ("errors", "Errors by scene: median, least and largest seed", partial(_errors, plain)),
        ("seconds", "Time by stage, mean over scenes", partial(_seconds, plain)),
    ]
    for study in studies:
        mine = [o for o in outcomes if o.varied is not None and o.varied[0] == study]
        asked.append((f"study-{study}", f"Study: {study}", partial(_study, study, mine)))
    made = []
    for name, title, draw in asked:
        figure = draw()
        if figure is not None:
            path = folder / f"{name}.png"
            figure.savefig(path, dpi=120)
            made.append((title, path))
    return made


def _errors(outcomes: Sequence[Outcome]) -> Figure | None:
    metrics = ("translation_mae", "rotation_mae")
    names, there = methods(outcomes), groups(outcomes)
    cells = {(g, n, m): cell(outcomes, g, n, m) for g in there for n in names for m in metrics}
    there = [g for g in there if any(np.isfinite(cells[g, n, metrics[0]].median) for n in names)]
    if not there:
        return None
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 1.4 + 0.16 * len(names) * len(there)), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for axis, metric, unit in zip(axes, metrics, ("mm", "mrad"), strict=True):
        for i, group in enumerate(there):
            if i % 2:
                axis.axhspan(i - 0.5, i + 0.5, color="#f4f4f4", zorder=0)
            for k, name in enumerate(names):
                y = i + 0.85 * ((k + 0.5) / len(names) - 0.5)
                _dot(axis, y, cells[group, name, metric], colour(name), name == "depthba")
        axis.set_xscale("log")
        axis.set_yticks(range(len(there)), there)
        axis.set_ylim(len(there) - 0.5, -0.5)
        axis.set_xlabel(f"mean absolute error, {metric.split('_')[0]} ({unit})")
        axis.grid(axis="x", which="major", color="#dddddd")
    handles = [
        _handle(name) for name in names
        if any(np.isfinite(cells[g, name, metrics[0]].median) for g in there)
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False)
    return figure


def _dot(axis: Axes, y: float, it: Cell, shade: str, ours: bool) -> None:
    if np.isfinite(it.median):
        axis.plot(1e3 * it.median, y, "D" if ours else "o", color=shade, ms=6 if ours else 4.5)
        axis.plot([1e3 * it.low, 1e3 * it.high], [y, y], "-", color=shade, lw=1.5)


def _handle(name: str) -> object:
    from matplotlib.lines import Line2D

    marker = "D" if name == "depthba" else "o"
    return Line2D([], [], color=colour(name), marker=marker, ls="none", label=entry(name).label)


def _seconds(outcomes: Sequence[Outcome]) -> Figure | None:
    done = [o for o in outcomes if o.status == "done" and o.total > 0]
    names = [n for n in methods(outcomes) if any(o.method == n for o in done)]
    if not names:
        return None
    from matplotlib.figure import Figure

    stages = {
        name: _mean_stages([o for o in done if o.method == name]) for name in names
    }  # fmt: skip
    figure = Figure(figsize=(8.5, 0.9 + 0.42 * len(names)), layout="constrained")
    axis = figure.subplots()
    longest = max(sum(s.values()) for s in stages.values())
    for i, name in enumerate(names):
        left = 0.0
        for k, (stage, seconds) in enumerate(stages[name].items()):
            shade = 0.95 - 0.5 * (k % 2)
            axis.barh(i, seconds, left=left, color=colour(name), alpha=shade, height=0.7)
            if seconds > 0.07 * longest:
                axis.text(left + seconds / 2, i, stage, ha="center", va="center", fontsize=7)
            left += seconds
        axis.text(left + 0.008 * longest, i, f"{left:.3g} s", va="center", fontsize=8)
    axis.set_yticks(range(len(names)), [entry(n).label for n in names])
    axis.set_ylim(len(names) - 0.5, -0.5)
    axis.set_xlim(0, 1.1 * longest)
    axis.set_xlabel("seconds")
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def _mean_stages(outcomes: Sequence[Outcome]) -> dict[str, float]:
    stages = list(dict.fromkeys(stage for o in outcomes for stage in o.seconds))
    return {s: float(np.mean([o.seconds.get(s, 0.0) for o in outcomes])) for s in stages}


def _study(study: str, outcomes: Sequence[Outcome]) -> Figure | None:
    """Draw errors, time and, over the start, the share of successes against what is varied."""
    names = methods(outcomes)
    values = sorted({o.varied[1] for o in outcomes if o.varied is not None})
    at = np.array(values) * SCALES.get(study, 1.0)
    if len(values) < 2:
        return None
    from matplotlib.figure import Figure

    last = ("successes, %", None) if study == "start" else ("time (s)", "total_seconds")
    panels = (
        ("translation (mm)", "translation_mae"), ("rotation (mrad)", "rotation_mae"), last,
    )  # fmt: skip
    figure = Figure(figsize=(11.5, 4.2), layout="constrained")
    for axis, (words, metric) in zip(figure.subplots(1, 3), panels, strict=True):
        for name in names:
            mine = [o for o in outcomes if o.method == name]
            if metric is None:
                axis.plot(at, _successes(mine, values), "o-", color=colour(name), ms=4)
                continue
            cells = [
                cell([o for o in mine if o.varied == (study, v)], g, name, metric)
                for v in values
                for g in [next(o.group for o in outcomes if o.varied == (study, v))]
            ]
            factor = 1.0 if metric == "total_seconds" else 1e3
            middle = factor * np.array(
                [c.median if np.isfinite(c.median) else np.nan for c in cells]
            )
            ends = factor * np.array([[c.low, c.high] for c in cells]).T
            axis.plot(
                at, middle, "o-", color=colour(name), ms=4, lw=2 if name == "depthba" else 1.2
            )
            if any(c.count > 1 for c in cells):
                axis.fill_between(at, *ends, color=colour(name), alpha=0.12, lw=0)
        axis.set_xlabel(AXES[study])
        axis.set_title(words, fontsize=10)
        if metric is not None:
            axis.set_yscale("log")
        if study in ("start", "noise"):
            axis.set_xscale("log")
            axis.set_xticks(at, [f"{v:g}" for v in at])
            axis.minorticks_off() if metric is None else axis.tick_params(
                axis="x", which="minor", length=0, labelbottom=False
            )
        axis.grid(color="#e4e4e4")
    figure.legend(handles=[_handle(n) for n in names], loc="outside lower center", ncols=6,
                  frameon=False)  # fmt: skip
    return figure


def _successes(outcomes: Sequence[Outcome], values: Sequence[float]) -> list[float]:
    """Return the share of seeds, %, that end near the method's own best median."""
    by_value = [
        [o.value("translation_mae") if o.status == "done" else np.inf for o in outcomes
         if o.varied is not None and o.varied[1] == v] for v in values
    ]  # fmt: skip
    medians = [float(np.median(e)) for e in by_value if e]
    best = min((m for m in medians if np.isfinite(m)), default=float("nan"))
    limit = GOOD["start"] * best
    return [100.0 * float(np.mean(np.array(e) < limit)) if e else float("nan") for e in by_value]
