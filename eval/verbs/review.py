"""`depthba review [RUN...]`: what happened in there?"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from depthba.errors import RunError
from depthba.verbs import DONE, WRONG_USAGE
from depthba.verbs.output import note, print_json
from eval import review
from eval.metrics import Metric
from eval.report import show, three_digits

if TYPE_CHECKING:
    from eval.recordings_table import Row


@dataclass(frozen=True)
class Arguments:
    """Open the recordings of runs in the Rerun viewer; a run without one gets one."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")] = ()
    """Run folders. None: the newest run, logs/latest."""
    compare: bool = False
    """Show several runs of one dataset side by side, with one table of figures."""
    table: bool = False
    """Print one line for each recording of these runs, or in and below these folders, and open
    nothing."""
    rebuild: bool = False
    """Make the recordings anew from the plain files of the run folders."""
    dataset: Path | None = None
    """Folder of the dataset, where it is not where it was. For --rebuild and --compare."""
    web: bool = False
    """Serve to a browser, on 127.0.0.1 alone, in place of opening a window."""
    port: int | None = None
    """Port for --web. None: a free one."""
    screenshot: Path | None = None
    """Write a picture of the viewer to this PNG; needs no screen, takes up to a minute."""
    json: bool = False
    """Print one JSON object on stdout and nothing else there: of --table the rows, in m, rad and
    s."""


def run(arguments: Arguments) -> int:
    """Show the recordings; return the exit status."""
    shown = [arguments.web, arguments.screenshot is not None, arguments.table]
    if sum(shown) > 1:
        note("depthba review: --web, --screenshot and --table exclude each other")
        return WRONG_USAGE
    if arguments.table and (arguments.compare or arguments.rebuild):
        note("depthba review: --table goes with neither --compare nor --rebuild")
        return WRONG_USAGE
    if arguments.table:
        return _table(arguments)
    if not arguments.compare:
        files = review.recordings(arguments.runs, arguments.rebuild, arguments.dataset)
        _open(arguments, files)
        return DONE
    from eval.compare import compare_runs

    with tempfile.TemporaryDirectory(prefix="depthba-") as folder:
        file = Path(folder) / "compare.rrd"
        compare_runs(arguments.runs, file, arguments.dataset)
        _open(arguments, [file])
    return DONE


def _open(arguments: Arguments, files: Sequence[Path]) -> None:
    """Show files the way that was asked for."""
    shot = arguments.screenshot
    if arguments.json:
        told = [str(r) for r in (arguments.runs if arguments.compare else files)]
        name = "runs" if arguments.compare else "recordings"
        print_json({name: told, "screenshot": str(shot) if shot else None})
    if shot is not None:
        review.screenshot(files, shot)
        if not arguments.json:
            print(shot)
    elif arguments.web:
        review.serve(files, arguments.port)
    else:
        review.show(files)


def _table(arguments: Arguments) -> int:
    """Print what the recordings say of themselves."""
    from eval.recordings_table import find_recordings, read_rows

    if not arguments.runs:
        raise RunError("review --table: no folder given, expected runs or a folder of runs")
    rows = read_rows(find_recordings(arguments.runs))
    if arguments.json:
        print_json({"recordings": [_as_json(row) for row in rows]})
    else:
        _print(rows)
    return DONE


def _as_json(row: Row) -> dict[str, Any]:
    return {
        "recording": str(row.recording),
        "problem": row.problem or None,
        "run": row.run,
        "metrics": row.metrics,
    }


def _print(rows: Sequence[Row]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table()
    for head in ("recording", "dataset", "preset"):
        table.add_column(head, overflow="fold")
    for head in ("seed", "translation", "rotation", "disagree", "time"):
        table.add_column(head, justify="right", no_wrap=True)
    table.add_column("status", overflow="fold", max_width=40)
    table.add_column("version", no_wrap=True)
    for row in rows:
        name = str(row.recording.parent if row.recording.name == "run.rrd" else row.recording)
        if row.problem:
            table.add_row(escape(name), *([""] * 7), f"[red]{escape(row.problem)}[/red]")
            continue
        run = row.run
        table.add_row(
            escape(name),
            escape(str(run.get("dataset", ""))),
            str(run.get("preset", "")),
            str(run.get("seed", "")),
            _figure(row, "translation_mae", "m"),
            _figure(row, "rotation_mae", "rad"),
            _figure(row, "spread_median", "m"),
            f"{three_digits(run['seconds'])} s" if "seconds" in run else "",
            str(run.get("status", "")).replace("_", " "),
            str(run.get("version_depthba", "")),
        )
    # a pipe has no width of its own, and a table must not be cut there
    Console(width=None if sys.stdout.isatty() else 180).print(table)


def _figure(row: Row, name: str, unit: Any) -> str:
    return show(Metric(name, unit, "lower", row.metrics[name])) if name in row.metrics else ""
