"""The verb ``register``: a dataset in, a run folder out."""

from __future__ import annotations

import contextlib
import importlib
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from depthba.convert import Reading
from depthba.errors import DatasetError, MissingPackage, OptionError
from depthba.options import Options
from depthba.verbs import DONE, NOT_TO_BE_TRUSTED, WRONG_USAGE
from depthba.verbs.output import angle, length, note, print_json

if TYPE_CHECKING:
    from depthba.dataset import Dataset
    from depthba.result import FrameReport, Iteration, Result


DATASET = "dataset"
"""Folder of a run that holds what was converted for it."""


@dataclass(frozen=True)
class Arguments:
    """Estimate every frame's pose and the depth map of a dataset.

    Exit status: 0 converged; 3 finished, but not to be trusted.
    """

    dataset: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]
    """Folder of the dataset; or a source of another format, as `depthba convert` takes it, which
    becomes the folder dataset of the run."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the run, new or empty. None: logs/<name>-<yyyymmdd-hhmmss>."""
    overwrite: bool = False
    """Write into the folder even where it holds an earlier run."""
    json: bool = False
    """Print one JSON object on stdout in place of text."""
    live: bool = False
    """Open the viewer at once, and show every step as it comes."""
    web: bool = False
    """With --live: serve to a browser, on 127.0.0.1 alone, in place of opening a window."""
    options: Annotated[Options, tyro.conf.arg(name="registration")] = field(default_factory=Options)
    reading: Annotated[Reading, tyro.conf.arg(name="source")] = field(default_factory=Reading)


@dataclass(frozen=True)
class Outcome:
    """A registration and where it was written."""

    result: Result
    run: Path
    """The run folder."""
    recording: Path | None
    """None: no recording was made."""
    seconds: float
    """Of the registration alone, without progress, recording and writing."""
    metrics: Mapping[str, float]
    """Value by name, as ``eval`` found them; empty where it was not asked."""


def run(arguments: Arguments) -> int:
    """Register a dataset, write the run folder, say how it went; return the exit status."""
    from depthba.dataset import Dataset
    from depthba.run_folder import default_path

    if arguments.web and not arguments.live:
        note("depthba register: --web goes with --live alone; `depthba review --web` comes after")
        return WRONG_USAGE
    with contextlib.ExitStack() as stack:
        out, overwrite, options = arguments.out, arguments.overwrite, arguments.options
        source = arguments.dataset
        if not source.exists():
            raise DatasetError(
                f"{source}: no such file or folder, expected a dataset, or a source that "
                "`depthba convert --list` names"
            )
        if not (source / "dataset.json").exists():
            out = default_path(source.stem) if out is None else out
            stack.enter_context(removed_on_failure(out, overwrite))
            dataset = _imported(arguments, out)
            overwrite, options = True, replace(options, every=1)
        else:
            if arguments.reading != Reading():
                raise OptionError(
                    f"{source}: a dataset says by itself how it is meant, expected no options of "
                    "how to read a source"
                )
            dataset = Dataset.open(source)
        for warning in dataset.warnings:
            note(f"warning: {warning}")
        viewer = stack.enter_context(_viewer(arguments))
        outcome = register_into(
            dataset,
            options,
            out,
            overwrite,
            viewer=None if viewer is None else viewer.address,
        )
        if arguments.json:
            print_json(summary(outcome))
        else:
            print("\n".join(report(dataset.name, outcome)), flush=True)
        if viewer is not None:
            viewer.stay()
    return DONE if outcome.result.trusted else NOT_TO_BE_TRUSTED


def _imported(arguments: Arguments, out: Path) -> Dataset:
    """Convert a source of another format into the run's own folder, where evaluate finds it."""
    from depthba.run_folder import RunFolder
    from depthba.verbs.convert import import_into

    RunFolder.create(out, overwrite=arguments.overwrite)
    if arguments.overwrite and (out / DATASET).is_dir():
        shutil.rmtree(out / DATASET)
    imported = import_into(
        out / DATASET, arguments.dataset, arguments.reading, arguments.options.every
    )
    for text in imported.notes:
        note(f"note: {text}")
    return imported.dataset


def register_into(
    dataset: Dataset,
    options: Options,
    out: Path | None = None,
    overwrite: bool = False,
    evaluate: bool = False,
    record: bool = True,
    viewer: str | None = None,
) -> Outcome:
    """Register a dataset into a run folder, with progress on stderr and a recording.

    Args:
        dataset: what to register.
        options: how.
        out: the run folder; None takes a new one in logs/.
        overwrite: whether the folder may hold an earlier run.
        evaluate: judge the run too, so that the recording shows the figures.
        record: make a recording.
        viewer: address of a viewer that shows every step as it comes; needs the recording.

    Raises:
        DepthbaError: the dataset, the options or the folder do not do. A folder that was
            made here is then removed again, as it is when the user interrupts.
    """
    import depthba
    from depthba.run_folder import RunFolder, default_path
    from depthba.selecting import selected
    from depthba.verbs.progress import RegistrationProgress

    taking_part = selected(dataset, options)
    path = default_path(dataset.name) if out is None else out
    with removed_on_failure(path, overwrite):
        folder = RunFolder.create(path, overwrite=overwrite)
        with (
            _recorder(path / "run.rrd", taking_part, options, record, viewer) as recorder,
            RegistrationProgress(dataset.name) as progress,
        ):
            callback = _Callback(progress, recorder)
            begin = time.perf_counter()
            result = depthba.register(dataset, options, callback=callback)
            seconds = time.perf_counter() - begin - callback.seconds
            progress.say("writing the run")
            folder.write(result, options, taking_part)
            metrics = importlib.import_module("eval.evaluate").evaluate(path) if evaluate else []
            if recorder is not None:
                recorder.finish(result, metrics)
    return Outcome(
        result,
        path,
        recording=None if recorder is None else path / "run.rrd",
        seconds=seconds,
        metrics={metric.name: metric.value for metric in metrics},
    )


def summary(outcome: Outcome) -> dict[str, Any]:
    """Return what ``--json`` prints: metres, radians, seconds."""
    result = outcome.result
    return {
        "status": result.status,
        "trusted": result.trusted,
        "reason": result.reason,
        "frames": len(result.frames),
        "iterations": len(result.history),
        "seconds": outcome.seconds,
        "largest_move_m": max((frame.move_t for frame in result.frames), default=0.0),
        "largest_move_rad": max((frame.move_r for frame in result.frames), default=0.0),
        "sigma_m": result.sigma,
        "fixed_pattern_m": result.fixed_pattern,
        "refused_pattern_m": result.refused_pattern,
        "spacing_m": result.depth_map.spacing,
        "weak": [
            {
                "frame": weak.frame,
                "name": weak.name,
                "sigma_m": weak.sigma,
                "prior_sigma_m": weak.prior_sigma,
            }
            for weak in result.weak
        ],
        "held": [{"frame": frame.frame, "why": frame.held} for frame in _held(result)],
        "run": str(outcome.run),
        "recording": None if outcome.recording is None else str(outcome.recording),
    }


def report(name: str, outcome: Outcome, most: int = 6) -> list[str]:
    """Return the lines for people; of weak directions and held frames the first ``most``."""
    result = outcome.result
    ny, nx = result.depth_map.shape
    lines = [
        f"{name}: {result.status.replace('_', ' ')}. {result.reason}",
        f"  frames        {len(result.frames)}, in {len(result.history)} iterations "
        f"and {outcome.seconds:.1f} s",
        f"  map           {nx} x {ny} nodes, {length(result.depth_map.spacing)} apart",
    ]
    if result.frames:
        far = max(result.frames, key=lambda frame: frame.move_t)
        turned = max(result.frames, key=lambda frame: frame.move_r)
        lines.append(
            f"  largest move  {length(far.move_t)} (frame {far.frame}), "
            f"{angle(turned.move_r)} (frame {turned.frame})"
        )
    lines.append(f"  sigma         {length(result.sigma)} of the residuals")
    if result.fixed_pattern:
        lines.append(
            f"  pattern       {length(result.fixed_pattern)} rms of the range, the same in every "
            "frame, found and taken off"
        )
    if result.refused_pattern:
        lines.append(
            f"  pattern       {length(result.refused_pattern)} rms would fit, but explains little: "
            "left in; look to the intrinsics"
        )
    lines += _first(
        "weak",
        [
            f"frame {weak.frame} along {weak.name}: the data leave {length(weak.sigma)}, "
            f"its measured pose {length(weak.prior_sigma)}"
            for weak in result.weak
        ],
        most,
    )
    held = [f"frame {frame.frame}: {frame.held}" for frame in _held(result)]
    lines += _first("held", held, most)
    lines.append(f"  run           {outcome.run}")
    lines.append(f"  picture       {outcome.run / 'map.png'}")
    if outcome.recording is not None:
        lines.append(f"  recording     {outcome.recording}")
    return lines


def _held(result: Result) -> list[FrameReport]:
    """Return the frames that stayed where they began; the first does so always, and is left out."""
    return [frame for frame in result.frames[1:] if frame.held]


def _first(title: str, items: list[str], most: int) -> list[str]:
    lines = [f"  {title if i == 0 else '':<13} {item}" for i, item in enumerate(items[:most])]
    if len(items) > most:
        lines.append(f"  {'':<13} and {len(items) - most} more, see result.json")
    return lines


@contextlib.contextmanager
def removed_on_failure(path: Path, overwrite: bool) -> Iterator[None]:
    """On any failure, interrupts too, remove what was begun in a folder.

    Args:
        path: the folder; where it holds something already, that is left alone.
        overwrite: whether the folder may hold an earlier run; that then counts as spoilt.
    """
    existed = path.exists()
    taken = path.is_dir() and any(path.iterdir())
    try:
        yield
    except BaseException:
        if taken and overwrite:
            # the earlier run may be part replaced: without result.json it counts for nothing
            (path / "run.rrd").unlink(missing_ok=True)
            (path / "result.json").unlink(missing_ok=True)
        elif not taken and path.is_dir():
            for item in path.iterdir():
                shutil.rmtree(item) if item.is_dir() else item.unlink()
            if not existed:
                path.rmdir()
        raise


@contextlib.contextmanager
def _viewer(arguments: Arguments) -> Iterator[Any]:
    """Give a viewer from the package above; where it is not wanted, None."""
    if not arguments.live:
        yield None
        return
    try:
        live = importlib.import_module("eval.live")
    except ImportError as error:
        raise MissingPackage(
            f"register --live needs {error.name}, which is not installed: "
            "pip install 'depthba[eval]'"
        ) from error
    with live.opened(arguments.web) as viewer:
        yield viewer


@contextlib.contextmanager
def _recorder(
    path: Path, dataset: Dataset, options: Options, wanted: bool, viewer: str | None
) -> Iterator[Any]:
    """Give a recorder from the package above; where it is not wanted or not there, None."""
    if not wanted:
        yield None
        return
    try:
        recording = importlib.import_module("eval.recording")
        recorder = recording.Recorder(path, dataset, options, viewer=viewer)
    except ImportError as error:
        note(f"note: no recording is made ({error}): pip install 'depthba[eval]'")
        yield None
        return
    try:
        yield recorder
    except BaseException:
        recorder.discard()
        raise


class _Callback:
    """Hands every iteration on, and counts the time that this takes."""

    def __init__(self, *listeners: Callable[[Iteration], None] | None) -> None:
        self._listeners = [listener for listener in listeners if listener is not None]
        self.seconds = 0.0

    def __call__(self, iteration: Iteration) -> None:
        begin = time.perf_counter()
        for listener in self._listeners:
            listener(iteration)
        self.seconds += time.perf_counter() - begin
