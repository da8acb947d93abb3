"""The verb ``demo``: one scene from end to end, to see in a minute what depthba does."""

from __future__ import annotations

import importlib
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from depthba.errors import RunError
from depthba.options import Options
from depthba.verbs import DONE, NOT_TO_BE_TRUSTED
from depthba.verbs.output import angle, length, print_json
from depthba.verbs.register import Outcome, register_into, removed_on_failure

SCENE = "industrial-6"
FRAMES, SIZE, START_ERROR = 21, (320, 240), (0.03, 0.02)

PICTURE = "before_after.png"
METHODS = {"paper": Options(preset="paper", resolution=0.05), "default": Options(resolution=0.025)}
"""In the order in which they run."""
SHOWN = "default"
"""The method whose run people look at."""


@dataclass(frozen=True)
class Arguments:
    """Generate a scene, register it with both presets, judge and record the outcome.

    Exit status: 0 the default preset converged; 3 it finished, but is not to be trusted.
    """

    out: Path | None = None
    """Folder for the dataset and the runs, new or empty. None: logs/demo-<yyyymmdd-hhmmss>."""
    seed: int = 0
    """Arrangement of the scene, noise and pose errors."""
    json: bool = False
    """Print one JSON object on stdout in place of text: errors in m and rad, times in s."""


@dataclass(frozen=True)
class Score:
    """How far a method's poses are from the truth, and how long it took."""

    mae_m: float
    """Mean absolute error per axis of the translations, frame 0 aligned, m."""
    mae_rad: float
    """The same of the rotations, rad."""
    seconds: float
    """Of the registration alone."""


def run(arguments: Arguments) -> int:
    """Run the demonstration and show its figures; return the exit status."""
    from depthba.dataset import Dataset
    from depthba.run_folder import default_path

    out = default_path("demo") if arguments.out is None else arguments.out
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RunError(f"{out}: is in the way, expected a new or empty folder")
    with removed_on_failure(out, overwrite=False):
        # the kernels compile on one core while the scene is rendered on the other
        compiling = subprocess.Popen([sys.executable, "-m", "depthba.optimiser.warm"])
        try:
            dataset = Dataset.open(_generate(out / "dataset", arguments.seed))
        finally:
            compiling.wait()
        outcomes = {
            name: register_into(dataset, options, out / name, evaluate=True, record=name == SHOWN)
            for name, options in METHODS.items()
        }
        picture = importlib.import_module("depthba.picture")
        picture.before_after(outcomes[SHOWN].result, dataset, out / PICTURE)
    scores = _scores(outcomes)
    if arguments.json:
        print_json({"methods": {name: vars(score) for name, score in scores.items()}})
    else:
        _show(scores, outcomes[SHOWN], out)
    return DONE if outcomes[SHOWN].result.trusted else NOT_TO_BE_TRUSTED


def _generate(path: Path, seed: int) -> Path:
    sim = importlib.import_module("sim")
    progress = importlib.import_module("sim.verbs.progress")
    options = sim.GenerateOptions(
        seed=seed, frames=FRAMES, size=SIZE, start_error=START_ERROR, rgb=False
    )
    with progress.FrameProgress(SCENE) as show:
        generated: Path = sim.generate(SCENE, path, options, show)
    return generated


def _scores(outcomes: dict[str, Outcome]) -> dict[str, Score]:
    def score(metrics: Any, prefix: str, seconds: float) -> Score:
        return Score(metrics[f"{prefix}translation_mae"], metrics[f"{prefix}rotation_mae"], seconds)

    scores = {"initial": score(outcomes[SHOWN].metrics, "start_", 0.0)}
    for name, outcome in outcomes.items():
        scores[name] = score(outcome.metrics, "", outcome.seconds)
    return scores


def _show(scores: dict[str, Score], shown: Outcome, out: Path) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    print(
        f"{SCENE}: {FRAMES} frames of {SIZE[0]} x {SIZE[1]} pixels, measured poses off by "
        f"{length(START_ERROR[0])} and {angle(START_ERROR[1])}\n"
        "Mean absolute error per axis, frame 0 aligned:"
    )
    table = Table(box=SIMPLE_HEAD)
    table.add_column("poses")
    for head in ("translation", "rotation", "time"):
        table.add_column(head, justify="right")
    for name, score in scores.items():
        seconds = f"{score.seconds:.1f} s" if score.seconds else ""
        table.add_row(
            name,
            f"{1e3 * score.mae_m:.3f} mm",
            f"{1e3 * score.mae_rad:.3f} mrad",
            seconds,
            style="bold" if name == SHOWN else "",
        )
    # a pipe has no width of its own, and a table must not be cut there
    Console(width=None if sys.stdout.isatty() else 100).print(table)
    print(f"  picture    {out / PICTURE}")
    print(f"  map        {shown.run / 'map.png'}")
    if shown.recording is not None:
        print(f"  recording  {shown.recording}")
        print(f"             depthba review {shown.run}  opens it")
    print(f"  dataset    {out / 'dataset'}")
