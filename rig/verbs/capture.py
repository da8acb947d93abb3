"""The verb ``capture``: a session on a rig, or its rehearsal."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from depthba.errors import MissingPackage, OptionError
from depthba.verbs import DONE, NOT_TO_BE_TRUSTED
from depthba.verbs.output import note, print_json
from depthba.verbs.progress import Bar

if TYPE_CHECKING:
    from rig.session.interrupts import Interrupts
    from rig.session.opening import Opened
    from rig.session.options import Session
    from rig.session.running import Listeners, Summary


@dataclass(frozen=True)
class Arguments:
    """Capture a dataset as a session file says; goes on by itself where an earlier run ended.

    Exit status: 0 every pose has its frame; 1 the session ended before its last pose, and the same
    command goes on with it; 3 it went through, but without a frame of some poses.
    """

    session: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SESSION.yaml")]
    """What to capture, with what; see docs/capture.md."""
    out: Path
    """Folder of the dataset: new, empty, or of this session."""
    dry_run: bool = False
    """Check everything and move nothing: the file, limits, reachability, rig, camera, disk. Draws
    the plan into <out>-plan.rrd."""
    rehearse: bool = False
    """Run against a simulated rig and camera, which are started and ended along with it."""
    speed: float = 1.0
    """With --rehearse: simulated seconds in a second."""
    scene: str | None = None
    """With --rehearse: the scene, in place of the session's; as `depthba generate` takes it."""
    live: bool = False
    """Show the session in a viewer as it goes."""
    web: bool = False
    """With --live: serve to a browser, on 127.0.0.1 alone, in place of opening a window."""
    retry_skipped: bool = False
    """Try the poses that an earlier run skipped once more."""
    json: bool = False
    """Print one JSON object on stdout in place of text: frames, skipped, seconds and the like."""


def run(arguments: Arguments) -> int:
    """Check, capture, say how it went; return the exit status."""
    from rig.session.interrupts import Interrupts
    from rig.session.opening import opened
    from rig.session.reading import read_session

    session = _chosen(read_session(arguments.session), arguments)
    interrupts = Interrupts()
    with contextlib.ExitStack() as stack:
        stack.enter_context(interrupts.heard())
        viewer = stack.enter_context(_viewer(arguments))
        bar = stack.enter_context(Bar(arguments.out.name, "checking"))
        bar.show("checking", 0, None)
        running = stack.enter_context(_rig(session, arguments))
        ready = stack.enter_context(
            opened(
                running,
                session,
                arguments.out,
                rehearsed=arguments.rehearse,
                move=not arguments.dry_run,
            )
        )
        for warning in ready.carrier.warnings:
            note(f"warning: {warning}")
        for label, reason in ready.plan.left_out:
            note(f"warning: {label} is left out: {reason}")
        if arguments.dry_run:
            return _tell_plan(arguments, ready)
        summary = _capture(arguments, session, running, ready, bar, viewer, interrupts)
    if arguments.json:
        print_json(_as_json(summary))
    else:
        print("\n".join(_text(summary)))
    if viewer is not None:
        with interrupts.heard():
            viewer.stay()
    return DONE if summary.complete else NOT_TO_BE_TRUSTED


def _chosen(session: Session, arguments: Arguments) -> Session:
    """The session with what the command line says of its rehearsal."""
    if not arguments.rehearse:
        if arguments.scene is not None or arguments.speed != 1.0:
            raise OptionError("--scene and --speed are for a rehearsal, expected --rehearse too")
        return session
    if arguments.scene is None:
        return session
    return dataclasses.replace(
        session, rehearsal=dataclasses.replace(session.rehearsal, scene=arguments.scene)
    )


@contextmanager
def _rig(session: Session, arguments: Arguments) -> Iterator[Session]:
    """Give the session as it is run: its own rig, or a simulated one."""
    if not arguments.rehearse:
        yield session
        return
    from rig.session.rehearsal import rehearsed

    with rehearsed(session, arguments.speed) as running:
        yield running


def _capture(
    arguments: Arguments,
    session: Session,
    running: Session,
    ready: Opened,
    bar: Bar,
    viewer: Any,
    interrupts: Interrupts,
) -> Summary:
    from rig.session import record
    from rig.session.running import Run

    path = arguments.out
    if ready.begun:
        writer = record.resume(path, ready.info)
        record.write_board(writer, session)
        for warning in writer.warnings:
            note(f"warning: {warning}")
    else:
        writer = record.begin(
            path, session, ready.space, ready.plan, ready.info, arguments.rehearse
        )
    with _listening(arguments, bar, viewer, writer.sensor) as listeners:
        capture = Run(
            running,
            ready.space,
            ready.plan,
            ready.carrier,
            ready.camera,
            ready.info,
            writer,
            listeners,
            arguments.retry_skipped,
            interrupts,
        )
        try:
            return capture()
        except KeyboardInterrupt:
            note(
                f"{path}: {len(writer)} of {len(ready.plan.joints)} frames are whole; the same"
                " command goes on with it"
            )
            raise


@contextmanager
def _listening(arguments: Arguments, bar: Bar, viewer: Any, sensor: Any) -> Iterator[Listeners]:
    """Give what shows the session, and asks."""
    from depthba.dataset import Dataset
    from rig.session.running import Listeners

    ask = _asking(bar) if sys.stdin.isatty() and sys.stderr.isatty() else None
    found: dict[str, Any] = {"say": lambda text, done, total: bar.show(text, done, total)}
    if ask is not None:
        found["ask"] = ask
    if viewer is None:
        yield Listeners(**found)
        return
    log = _live().CaptureLog(sensor, arguments.out.name, viewer=viewer.address)
    for frame in Dataset.open(arguments.out):
        log.add(frame)
    found["moved"] = log.moved
    found["committed"] = lambda frame: log.add(Dataset.open(arguments.out)[-1])
    try:
        yield Listeners(**found)
    except BaseException:
        log.discard()
        raise
    log.finish()


def _asking(bar: Bar) -> Callable[[str], bool]:
    def ask(question: str) -> bool:
        with bar.paused():
            print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
            return sys.stdin.readline().strip().lower() in ("y", "yes")

    return ask


def _live() -> Any:
    """The package above, where it is installed."""
    try:
        return importlib.import_module("eval.live")
    except ImportError as error:
        raise MissingPackage(
            f"capture --live needs {error.name}, which is not installed:"
            " pip install 'depthba[eval]'"
        ) from error


@contextmanager
def _viewer(arguments: Arguments) -> Iterator[Any]:
    """Give a viewer; where it is not wanted, None."""
    if not arguments.live:
        yield None
        return
    with _live().opened(arguments.web) as viewer:
        yield viewer


def _tell_plan(arguments: Arguments, ready: Opened) -> int:
    """Draw the plan and say that everything is there."""
    from rig.session.drawing import draw_plan

    drawn: Path | None = arguments.out.with_name(f"{arguments.out.name}-plan.rrd")
    assert drawn is not None
    try:
        drawn.parent.mkdir(parents=True, exist_ok=True)
        start = ready.carrier.state().joints
        draw_plan(ready.plan, ready.space, ready.info, start, drawn)
    except ImportError as error:
        note(f"note: the plan is not drawn ({error}): pip install 'depthba[eval]'")
        drawn = None
    plan, unit = ready.plan, ready.space.body.unit
    if arguments.json:
        print_json(
            {
                "dry_run": True,
                "stations": len(plan.joints),
                "labels": list(plan.labels),
                "joints": plan.joints.tolist(),
                "T_world_camera": plan.T_world_camera.tolist(),
                "left_out": [{"label": a, "reason": b} for a, b in plan.left_out],
                "way": plan.length,
                "unit": unit,
                "camera": ready.info.model,
                "resumes": ready.begun,
                "recording": None if drawn is None else str(drawn),
            }
        )
        return DONE
    camera = ready.info.camera
    lines = [
        f"{arguments.session}: nothing is in the way. {len(plan.joints)} poses"
        + (f", {len(plan.left_out)} left out" if plan.left_out else ""),
        f"  camera     {ready.info.model or 'no name'}, {camera.width} x {camera.height}",
        f"  dataset    {arguments.out}, {'to be gone on with' if ready.begun else 'new'}",
    ]
    if plan.length:
        lines.insert(1, f"  way        {plan.length:.3g} {unit} of the joint that goes furthest")
    if drawn is not None:
        lines.append(f"  plan       {drawn}: depthba review {drawn}")
    print("\n".join(lines))
    return DONE


def _as_json(summary: Summary) -> dict[str, Any]:
    return {
        "dataset": str(summary.path),
        "complete": summary.complete,
        "stations": summary.stations,
        "frames": summary.frames,
        "taken": summary.taken,
        "skipped": [dataclasses.asdict(entry) for entry in summary.skipped],
        "left_out": [{"label": a, "reason": b} for a, b in summary.left_out],
        "retries": summary.retries,
        "stops": summary.stops,
        "seconds": summary.seconds,
    }


def _text(summary: Summary) -> list[str]:
    lines = [
        f"{summary.path}: {summary.frames} of {summary.stations} frames, {summary.taken} of them"
        f" now, in {summary.seconds:.1f} s"
    ]
    if summary.retries:
        lines.append(f"  tried again  {summary.retries} times")
    if summary.stops:
        lines.append(f"  stopped      {summary.stops} times")
    lines += [f"  skipped      {entry.label}: {entry.reason}" for entry in summary.skipped]
    lines += [f"  left out     {label}: {reason}" for label, reason in summary.left_out]
    return lines
