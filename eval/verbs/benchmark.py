"""`depthba benchmark`: every method on every dataset, judged alike."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from depthba.errors import OptionError, RunError
from depthba.verbs import DONE
from depthba.verbs.output import print_json

if TYPE_CHECKING:
    from eval.benchmark.outcome import Outcome
    from eval.benchmark.plan import Case, Job
    from eval.benchmark.report import Report

    Drawn = list[tuple[str, Path]]


@dataclass(frozen=True)
class Arguments:
    """Run methods on datasets and scenes, judge them alike, and write tables and plots.

    Given again, the command goes on where it was stopped, and runs only what is missing. A method
    that finds nothing, crashes, or runs out of time or memory is a row with its reason.
    """

    datasets: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PATH...")] = ()
    """Dataset folders."""
    scenes: Annotated[str | None, tyro.conf.arg(metavar="A,B")] = None
    """Simulated scenes, which are generated below --out."""
    methods: Annotated[str | None, tyro.conf.arg(metavar="A,B")] = None
    """Methods, see --list, and your own as module:Class. None: all."""
    seeds: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Take each scene with N seeds: 0 to N - 1. Figures are medians over them."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for everything. None: logs/benchmark."""
    paper: bool = False
    """The paper's two tables and its timing on simulated likenesses of its six scenes, with the
    paper's figures beside ours, and pictures of the merged clouds."""
    quick: bool = False
    """A look within minutes: fewer and smaller frames."""
    study: Annotated[str | None, tyro.conf.arg(metavar="A,B")] = None
    """Vary one thing at a time on one scene (the first of --scenes, else industrial-5): start,
    noise, frames, overlap, resolution."""
    start_error: Annotated[tuple[float, float], tyro.conf.arg(metavar="M RAD")] = (0.01, 0.02)
    """Standard deviations per axis of the scenes' start poses, m and rad; frame 0 is exact."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH")] = None
    """Image size of the scenes, pixels. None: 320 wide."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Datasets that are worked on side by side. None: one for each core."""
    threads: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Threads of each method."""
    scheduler: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Instead of this machine: a Dask scheduler whose workers have depthba and see the same
    files."""
    time_limit: Annotated[float, tyro.conf.arg(metavar="S")] = 900.0
    """Seconds after which a method is stopped."""
    memory_limit: Annotated[float, tyro.conf.arg(metavar="GB")] = 8.0
    """Memory above which a method is stopped."""
    list: bool = False
    """Show the methods, and do nothing else."""
    json: bool = False
    """Print what results.json holds on stdout and nothing else there."""


def run(arguments: Arguments) -> int:
    """Run what is asked for, write the report; return the exit status."""
    from eval.benchmark import report, runner
    from eval.benchmark.plan import Job
    from eval.verbs.progress import BenchmarkProgress

    if arguments.list:
        _list(arguments.json)
        return DONE
    runner.check(arguments.workers, arguments.scheduler)
    _check(arguments)
    out = (arguments.out or Path("logs/benchmark")).absolute()
    if out.exists() and not out.is_dir():
        raise RunError(f"{out}: is a file, expected a folder for the benchmark")
    methods, cases = _methods(arguments), _cases(arguments, out)
    jobs = [
        Job(
            case, methods, out, arguments.threads, arguments.time_limit,
            1e9 * arguments.memory_limit,
        )
        for case in cases
    ]  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    with BenchmarkProgress() as told:
        outcomes = runner.run(jobs, arguments.workers, arguments.scheduler, told)
        told(len(outcomes), len(outcomes), "drawing")
        plots, pictures = _draw(arguments, jobs, outcomes, out)
    made = report.assemble(outcomes, arguments.paper, _command(), plots, pictures)
    files = report.write(made, out)
    if arguments.json:
        print_json(report.results(made))
    else:
        _show(made, files)
    return DONE


def _check(arguments: Arguments) -> None:
    if arguments.quick and not arguments.paper:
        raise OptionError("--quick: expected --paper beside it")
    if arguments.seeds < 1:
        raise OptionError(f"--seeds {arguments.seeds}: expected 1 or more, it is a count")
    for name in ("threads", "time_limit", "memory_limit"):
        value = getattr(arguments, name)
        if not value > 0:
            raise OptionError(f"--{name.replace('_', '-')} {value:g}: expected a number above 0")


def _names(text: str | None) -> list[str]:
    return [name.strip() for name in (text or "").split(",") if name.strip()]


def _methods(arguments: Arguments) -> tuple[str, ...]:
    from eval.benchmark.plan import QUICK_METHODS, methods_of

    if arguments.quick and arguments.methods is None:
        return QUICK_METHODS
    return methods_of(arguments.methods)


def _cases(arguments: Arguments, out: Path) -> list[Case]:
    from eval.benchmark import plan
    from sim.verbs.generate import parse_size

    size = None if arguments.size is None else parse_size(arguments.size)
    frames = None
    scenes = _names(arguments.scenes)
    if arguments.paper:
        scenes = scenes or [*plan.LABS, *plan.BAYS]
        if arguments.quick:
            size, frames = size or plan.QUICK_SIZE, plan.QUICK_FRAMES
    studies = _names(arguments.study)
    for study in studies:
        if study not in plan.STUDIES:
            raise OptionError(f"--study {study}: unknown; choose from: {', '.join(plan.STUDIES)}")
    if studies:
        scene = (scenes or ["industrial-5"])[0]
        return [c for s in studies for c in plan.study_cases(s, scene, arguments.seeds, out)]
    cases = plan.given_cases(arguments.datasets)
    cases += plan.scene_cases(scenes, arguments.seeds, out, arguments.start_error, size, frames)
    if not cases:
        raise OptionError(
            "nothing to run: expected --datasets PATH, --scenes A,B, --study A,B or --paper"
        )
    return cases


def _draw(
    arguments: Arguments, jobs: Sequence[Job], outcomes: Sequence[Outcome], out: Path
) -> tuple[Drawn, Drawn]:
    from eval.benchmark import pictures, plots

    drawn = plots.draw_all(outcomes, out / "plots")
    shown = pictures.of_jobs(jobs, outcomes, out / "plots") if arguments.paper else []
    return drawn, shown


def _command() -> str:
    words = sys.argv[1:]
    return shlex.join(["depthba", *words])


def _list(as_json: bool) -> None:
    from eval.methods import METHODS, missing

    if as_json:
        print_json({n: {"label": e.label, "missing": list(missing(n))} for n, e in METHODS.items()})
        return
    width = max(map(len, METHODS))
    for name, entry in METHODS.items():
        absent = missing(name)
        note = f"  (needs {', '.join(absent)}: pip install 'depthba[eval]')" if absent else ""
        print(f"{name:<{width}}  {entry.label}{note}")


def _show(made: Report, files: Sequence[Path]) -> None:
    """Print the verdict, the main figures and where everything is."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else 200)
    for table in made.tables:
        shown = Table(box=SIMPLE_HEAD, title=table.title, title_justify="left")
        for head in ("scene", "", *table.columns):
            shown.add_column(head, justify="left" if head in ("scene", "") else "right")
        for line in table.lines:
            marks = {0: "{}", 1: "[bold]{}[/bold]", 2: "[underline]{}[/underline]"}
            cells = [marks[e.rank].format(e.text) for e in line.entries]
            words = f"paper: {line.words}" if line.paper else line.words
            shown.add_row(line.scene, words, *cells, style="dim" if line.paper else "")
        console.print(shown)
    for said in made.verdict:
        console.print(f"{said}.", markup=False)
    failed = sum(o.status != "done" for o in made.outcomes)
    if failed:
        console.print(f"{failed} of {len(made.outcomes)} runs failed, see the report")
    for file in files:
        console.print(f"  {file}", markup=False, soft_wrap=True)
