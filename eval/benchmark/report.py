"""report.md, report.html, results.json and the LaTeX tables of a benchmark."""

from __future__ import annotations

import base64
import datetime
import importlib.metadata
import platform
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from depthba import durable
from depthba.run_folder import versions
from eval.benchmark import tables
from eval.benchmark.outcome import Outcome
from eval.benchmark.paper import SECONDS
from eval.benchmark.plan import BAYS, LABS
from eval.benchmark.summary import Row, groups, row
from eval.methods import entry
from eval.report import three_digits

OURS = "depthba"


@dataclass(frozen=True)
class Report:
    """All that the files are written from."""

    title: str
    outcomes: tuple[Outcome, ...]
    with_paper: bool
    command: str
    """That made it."""
    plots: tuple[tuple[str, Path], ...] = ()
    """Title and file."""
    pictures: tuple[tuple[str, Path], ...] = ()
    tables: tuple[tables.Table, ...] = field(default=())
    verdict: tuple[str, ...] = ()
    """A line each: who is first where, and why not us."""


def assemble(
    outcomes: Sequence[Outcome],
    with_paper: bool,
    command: str,
    plots: Sequence[tuple[str, Path]] = (),
    pictures: Sequence[tuple[str, Path]] = (),
) -> Report:
    """Rank and lay out."""
    title = "The paper's tables, measured" if with_paper else "Benchmark"
    return Report(
        title, tuple(outcomes), with_paper, command, tuple(plots), tuple(pictures),
        tuple(tables.usual_tables(outcomes, with_paper)), tuple(verdict(outcomes, with_paper)),
    )  # fmt: skip


def write(report: Report, out: Path) -> list[Path]:
    """Write all files into the folder; return them."""
    made = [out / name for name in ("results.json", "report.md", "report.html", "tables.tex")]
    durable.write_json(made[0], results(report))
    durable.write_text(made[1], markdown(report, out))
    durable.write_text(made[2], html(report))
    tex = "\n".join(tables.latex(t, f"benchmark-{k + 1}") for k, t in enumerate(report.tables))
    durable.write_text(made[3], tex)
    return made


def results(report: Report) -> dict[str, Any]:
    """Return what results.json holds: metres, radians, seconds, bytes; unknown is null."""
    plain = [o for o in report.outcomes if o.varied is None]
    names = list(dict.fromkeys(m.name for o in plain for m in o.metrics))
    summary = {
        group: {
            metric: {
                name: {
                    "median": _number(c.median), "low": _number(c.low), "high": _number(c.high),
                    "done": c.done, "seeds": c.count,
                }
                for name, c in row(plain, group, metric).cells.items()
            }
            for metric in [*names, "total_seconds", "memory"]
        }
        for group in groups(plain)
    }  # fmt: skip
    return {
        "format": "depthba-benchmark",
        "version": 1,
        "command": report.command,
        "versions": all_versions(),
        "verdict": list(report.verdict),
        "summary": summary,
        "outcomes": [o.as_json() for o in report.outcomes],
    }


def verdict(outcomes: Sequence[Outcome], with_paper: bool) -> list[str]:
    """Say in how many rows depthba is first, and what is known of those where it is not."""
    plain = [o for o in outcomes if o.varied is None]
    if not any(o.method == OURS for o in plain):
        return []
    there = groups(plain)
    asked = [
        ("poses, laboratory scenes", [g for g in there if g in LABS], tables.POSE_METRICS),
        ("marker distances", [g for g in there if g in BAYS], tables.MARKER_METRICS),
        (
            "poses, other scenes",
            [g for g in there if g not in LABS],
            tables.POSE_METRICS,
        ),
    ]
    lines = []
    for words, among, metrics in asked:
        rows = [row(plain, group, metric) for group in among for metric in metrics]
        rows = [r for r in rows if r.best is not None]
        if not rows or sum(entry(n).ranked for n in rows[0].cells) < 2:
            continue
        first = sum(r.best == OURS for r in rows)
        lines.append(f"{words}: depthba is first in {first} of {len(rows)} rows")
        lines += [_behind(r, plain) for r in rows if r.best != OURS]
    return lines


def _behind(it: Row, outcomes: Sequence[Outcome]) -> str:
    """Say by how much depthba is behind in a row, and what it said itself."""
    assert it.best is not None
    best, ours = it.cells[it.best], it.cells.get(OURS)
    words = tables.WORDS.get(it.metric, it.metric)
    start = f"{it.group}, {words}: {entry(it.best).label} is first"
    mine = [o for o in outcomes if o.group == it.group and o.method == OURS]
    if ours is None or not np.isfinite(ours.median):
        reasons = "; ".join(dict.fromkeys(o.reason for o in mine if o.reason)) or "no figure"
        return f"{start}; depthba: {reasons}"
    factor = tables.FACTORS.get(it.metric, 1e3)
    told = (
        f"{start} with {three_digits(factor * best.median)}, depthba "
        f"{three_digits(factor * ours.median)}"
    )
    if ours.count > 1 and ours.low <= best.median:
        told += f" ({three_digits(factor * ours.low)} to {three_digits(factor * ours.high)})"
        told += ", a difference smaller than the spread over the seeds"
    notes = list(dict.fromkeys(note for o in mine for note in o.notes))
    if notes:
        told += f"; depthba said itself: {notes[0]}"
    return told


def failures(outcomes: Sequence[Outcome]) -> list[tuple[str, str, str, str]]:
    """Return dataset, method, status and reason of what was not done, and notes on what was."""
    rows: list[tuple[str, str, str, str]] = [
        (o.dataset, entry(o.method).label, o.status, o.reason)
        for o in outcomes
        if o.status != "done"
    ]
    for o in outcomes:
        if o.status == "done" and o.notes:
            more = f" (and {len(o.notes) - 2} more)" if len(o.notes) > 2 else ""
            said = "; ".join(o.notes[:2]) + more
            rows.append((o.dataset, entry(o.method).label, "note", said))
    return rows


def facts(report: Report) -> list[tuple[str, str]]:
    """Return how it was run."""
    limits = report.outcomes[0].limits if report.outcomes else {}
    rows = [
        ("Command", f"`{report.command}`"),
        ("When", datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")),
        ("Machine", f"{platform.machine()}, {_processor()}"),
        ("Versions", ", ".join(f"{k} {v}" for k, v in all_versions().items())),
    ]
    if limits:
        rows.append(
            ("Limits", f"{limits['seconds']:.0f} s and {limits['bytes'] / 1e9:.3g} GB a method")
        )
    if report.with_paper:
        told = "; ".join(f"{entry(m).label} {text} s" for m, text in SECONDS.items())
        rows.append(("Time in the paper, on its scene 6", told))
    return rows


def all_versions() -> dict[str, str]:
    """Return the versions of what the methods are built on."""
    out = dict(versions())
    for package in ("open3d", "small_gicp", "gtsam", "kiss_matcher"):
        try:
            out[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    out.pop("machine", None)
    return out


def markdown(report: Report, out: Path) -> str:
    """Return report.md."""
    parts = [f"# {report.title}"]
    if report.verdict:
        parts.append("\n".join(f"- {_first_up(line)}." for line in report.verdict))
    parts += [tables.markdown(t).strip() for t in report.tables]
    for title, path in (*report.plots, *report.pictures):
        parts.append(f"### {title}\n\n![{title}]({path.relative_to(out).as_posix()})")
    if rows := failures(report.outcomes):
        lines = ["| Dataset | Method | | Reason |", "| --- | --- | --- | --- |"]
        lines += [f"| {a} | {b} | {c} | {d.replace('|', '/')} |" for a, b, c, d in rows]
        parts.append("### Failures and remarks\n\n" + "\n".join(lines))
    parts.append(
        "### How it was run\n\n| | |\n| --- | --- |\n"
        + "\n".join(f"| {a} | {b} |" for a, b in facts(report))
    )
    return "\n\n".join(parts) + "\n"


def html(report: Report) -> str:
    """Return report.html: one file that holds its pictures, readable on a phone."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("eval.benchmark", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    pictures = [(title, _inline(path)) for title, path in (*report.plots, *report.pictures)]
    return environment.get_template("page.html.j2").render(
        title=report.title,
        verdict=[_first_up(line) for line in report.verdict],
        tables=report.tables,
        pictures=pictures,
        failures=failures(report.outcomes),
        facts=[(a, b.replace("`", "")) for a, b in facts(report)],
    )


def _inline(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()


def _first_up(text: str) -> str:
    return text[:1].upper() + text[1:]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _processor() -> str:
    """Return the processor's name and the number of cores that this process may use."""
    from sim.workers import cores

    name = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if not name and cpuinfo.is_file():
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
        name = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), "")
    return f"{name or 'unknown processor'}, {cores()} cores"
