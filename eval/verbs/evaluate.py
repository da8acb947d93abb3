"""`depthba evaluate RUN...`: how good are these runs?"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from depthba.verbs import DONE, WRONG_USAGE
from depthba.verbs.output import note, print_json
from eval.evaluate import MAX_GAP, Evaluation, as_json, save
from eval.report import NAMES, SURFACES, VERDICTS, against, gain, show


@dataclass(frozen=True)
class Arguments:
    """Measure runs against truth, or against themselves where there is none.

    Leaves metrics.json and report.md in every run folder.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
    """Run folders, as register leaves them."""
    dataset: Path | None = None
    """Folder of the dataset. None: the one that each run remembers."""
    truth: Path | None = None
    """File of true poses, TUM, such as of motion capture: interpolated at the stamps of the frames;
    frames without a pose count in no error. None: poses_true.txt of the dataset, if it has one."""
    max_gap: float = MAX_GAP
    """Poses of --truth are interpolated over no longer a gap, s."""
    cell: float | None = None
    """Edge of the cells in which frames are compared, m. None: four point spacings."""
    bound: bool = False
    """Compute the Cramér-Rao bound too, at the run's map spacing, and the errors over it. Needs
    true poses and a stated noise; takes seconds to minutes."""
    json: bool = False
    """Print one JSON object on stdout and nothing else there."""


def run(arguments: Arguments) -> int:
    """Evaluate every run and print the figures; return the exit status."""
    if not arguments.runs:
        note("depthba evaluate: no run folder given, expected one or more")
        return WRONG_USAGE
    judged = []
    for path in arguments.runs:
        one = save(
            path,
            arguments.dataset,
            arguments.truth,
            arguments.cell,
            arguments.bound,
            arguments.max_gap,
        )
        judged.append(one)
        if not arguments.json:
            _print(one)
    if arguments.json:
        print_json({"runs": [as_json(one) for one in judged]})
    return DONE


def _print(judged: Evaluation) -> None:
    """Print the figures that count: start, estimate, gain."""
    from rich.console import Console
    from rich.table import Table

    status = str(judged.run.result["status"])
    table = Table(
        title=f"{judged.run.name}: {VERDICTS.get(status, status)}",
        caption=f"{judged.run.path / 'report.md'}",
        title_justify="left",
        caption_justify="left",
    )
    for head in ("", "start poses", "depthba", "better by"):
        table.add_column(head, justify="right" if head else "left", no_wrap=True)
    before = {m.name: m for m in judged.start_metrics}
    now = {m.name: m for m in judged.metrics}
    for name, words in NAMES.items():
        if name in now:
            first = show(before[name]) if name in before else ""
            table.add_row(words, first, show(now[name]), gain(before.get(name), now[name]))
    if judged.bound is not None:
        table.caption = f"{SURFACES[judged.bound.surface]}\n{table.caption}"
    table.caption = f"{against(judged)}\n{table.caption}"
    # a pipe has no width of its own, and a table must not be cut there
    Console(width=None if sys.stdout.isatty() else 120).print(table)
