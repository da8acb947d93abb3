"""The tables of a benchmark: rows of figures by method, written as Markdown and as LaTeX."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eval.benchmark import paper
from eval.benchmark.outcome import Outcome
from eval.benchmark.plan import BAYS, LABS
from eval.benchmark.summary import Cell, groups, methods, row
from eval.methods import entry
from eval.report import three_digits

WORDS = {
    "translation_mae": "MAE, translation (mm)",
    "translation_rmse": "RMSE, translation (mm)",
    "rotation_mae": "MAE, rotation (mrad)",
    "rotation_rmse": "RMSE, rotation (mrad)",
    "marker_error_x": "Markers along X (mm)",
    "marker_error_y": "Markers along Y (mm)",
    "spread_median": "Frames disagree, median cell (mm)",
    "point_to_plane_median": "Point to plane, median pair (mm)",
    "nees_per_dof": "NEES per degree of freedom",
    "total_seconds": "Time (s)",
    "memory": "Peak memory (GB)",
}
FACTORS = {"nees_per_dof": 1.0, "total_seconds": 1.0, "memory": 1e-9}
"""From the metric's unit to the table's; 1000 where nothing else is said."""
POSE_METRICS = ("translation_mae", "translation_rmse", "rotation_mae", "rotation_rmse")
MARKER_METRICS = ("marker_error_y", "marker_error_x")
MAP_METRICS = ("spread_median", "point_to_plane_median")


@dataclass(frozen=True)
class Entry:
    """One figure of a table."""

    text: str
    rank: int = 0
    """1: best of its row, 2: second, 0: neither."""
    note: str = ""
    """For a footnote."""


@dataclass(frozen=True)
class Line:
    """One row of a table."""

    scene: str
    """Empty where it is that of the line above."""
    words: str
    entries: tuple[Entry, ...]
    paper: bool = False
    """Whether these are the paper's figures."""


@dataclass(frozen=True)
class Table:
    """A table: one column a method."""

    title: str
    explanation: str
    columns: tuple[str, ...]
    lines: tuple[Line, ...]

    @property
    def notes(self) -> list[str]:
        """The footnotes, each once."""
        return list(dict.fromkeys(e.note for line in self.lines for e in line.entries if e.note))


def table(
    outcomes: Sequence[Outcome],
    title: str,
    explanation: str,
    metrics: Sequence[str],
    among: Sequence[str] | None = None,
    printed: dict[str, dict[str, dict[str, float]]] | None = None,
) -> Table | None:
    """Lay out metrics of groups; None where nothing was measured.

    Args:
        outcomes: of the benchmark.
        title: of the table.
        explanation: a sentence below it.
        metrics: names of metrics, a line each.
        among: the groups; None: all.
        printed: the paper's figures by group, metric and method.

    """
    names = methods(outcomes)
    lines: list[Line] = []
    for group in groups(outcomes) if among is None else among:
        first = group
        for metric in metrics:
            found = row(outcomes, group, metric)
            if not any(np.isfinite(c.median) for c in found.cells.values()):
                continue
            entries = tuple(
                Entry(
                    _shown(found.cells[name], metric),
                    1 if name == found.best else 2 if name == found.second else 0,
                )
                for name in names
            )
            lines.append(Line(first, WORDS.get(metric, metric), entries))
            first = ""
            told = (printed or {}).get(group, {}).get(metric)
            if told:
                lines.append(_of_paper(group, metric, names, told))
    if not lines:
        return None
    return Table(title, explanation, tuple(entry(name).label for name in names), tuple(lines))


def usual_tables(outcomes: Sequence[Outcome], with_paper: bool) -> list[Table]:
    """Return the tables of a report: poses, markers, map, certainty, time."""
    plain = [o for o in outcomes if o.varied is None]
    there = groups(plain)
    labs = [g for g in there if g in LABS]
    bays = [g for g in there if g in BAYS]
    others = [g for g in there if g not in labs]
    seeds = max((len({o.seed for o in plain if o.group == g}) for g in there), default=1)
    medians = f"Medians over {seeds} seeds" if seeds > 1 else "One seed: no result, only a look"
    printed = (paper.POSES, paper.MARKERS) if with_paper else ({}, {})
    theirs = (
        " Lines marked *paper* are the paper's own figures, from other data." if with_paper else ""
    )
    asked = [
        table(
            plain, "Poses, laboratory scenes" if with_paper else "Poses",
            f"{medians}; frame 0 put onto the truth. **Best**, _second_.{theirs}",
            POSE_METRICS, labs if with_paper else there, printed[0],
        ),
        table(
            plain, "Marker distances, industrial scenes",
            f"{medians}. Error of the distance between markers.{theirs}",
            MARKER_METRICS, bays, printed[1],
        ),
        table(
            plain, "Poses, other scenes", f"{medians}; frame 0 put onto the truth.",
            POSE_METRICS, others,
        ) if with_paper else None,
        table(
            plain, "How well the frames agree",
            f"{medians}. Disagreement of frames that see the same ground; needs no truth.",
            MAP_METRICS, there,
        ),
        table(
            plain, "Honesty", "Errors squared over what the covariance allows: 1 is honest.",
            ("nees_per_dof",), there,
        ),
        table(
            plain, "Time and memory",
            "Seconds of all stages, feature pairs charged to every method that uses them; memory "
            "of the whole process.",
            ("total_seconds", "memory"), there,
        ),
    ]  # fmt: skip
    return [t for t in asked if t is not None]


def markdown(it: Table) -> str:
    """Write a table as Markdown."""
    head = ["Scene", "", *it.columns]
    rows = [head, ["---", "---", *["---:"] * len(it.columns)]]
    for line in it.lines:
        marks = {0: "{}", 1: "**{}**", 2: "_{}_"}
        cells = [marks[e.rank].format(e.text) + ("†" if e.note else "") for e in line.entries]
        rows.append([line.scene, f"_paper_ {line.words}" if line.paper else line.words, *cells])
    body = "\n".join("| " + " | ".join(r) + " |" for r in rows)
    notes = "".join(f"\n\n† {note}." for note in it.notes)
    return f"### {it.title}\n\n{it.explanation}\n\n{body}{notes}\n"


def latex(it: Table, label: str) -> str:
    """Write a table as LaTeX with booktabs."""
    lines = [
        "% needs \\usepackage{booktabs}",
        "\\begin{table*}",
        "\\centering",
        f"\\caption{{{_escaped(it.title)}}}",
        f"\\label{{tab:{label}}}",
        f"\\begin{{tabular}}{{ll{'r' * len(it.columns)}}}",
        "\\toprule",
        " & ".join(["Scene", "", *map(_escaped, it.columns)]) + " \\\\",
    ]
    marks = {0: "{}", 1: "\\textbf{{{}}}", 2: "\\underline{{{}}}"}
    for line in it.lines:
        if line.scene:
            lines.append("\\midrule")
        words = _escaped(line.words)
        if line.paper:
            words = f"\\emph{{paper}} {words}"
        cells = [marks[e.rank].format(_escaped(e.text)) for e in line.entries]
        lines.append(" & ".join([_escaped(line.scene), words, *cells]) + " \\\\")
    lines += ["\\bottomrule", "\\end{tabular}", "\\end{table*}"]
    return "\n".join(lines) + "\n"


def _shown(cell: Cell, metric: str) -> str:
    factor = FACTORS.get(metric, 1e3)
    if np.isinf(cell.median):
        return "failed"
    if np.isnan(cell.median):
        return "–"
    text = three_digits(factor * cell.median)
    if cell.done < cell.count:
        text += f" ({cell.done}/{cell.count})"
    return text


def _of_paper(group: str, metric: str, names: Sequence[str], told: dict[str, float]) -> Line:
    ordered = sorted(told, key=lambda name: told[name])
    entries = []
    for name in names:
        slip = paper.SLIPS.get((group, metric, name), "")
        if name in told:
            rank = ordered.index(name) + 1 if name in ordered[:2] else 0
            note = f"{group}, {entry(name).label}, the paper's figure: {slip}" if slip else ""
            entries.append(Entry(three_digits(1e3 * told[name]), rank, note))
        else:
            entries.append(Entry(""))
    return Line("", WORDS[metric], tuple(entries), paper=True)


def _escaped(text: str) -> str:
    for raw, safe in (("\\", "\\textbackslash{}"), ("_", "\\_"), ("%", "\\%"), ("&", "\\&")):
        text = text.replace(raw, safe)
    return text.replace("–", "--")
