"""The verb `generate`: a scene and a seed in, a dataset with known truth out; or many of them."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from depthba.errors import OptionError
from depthba.verbs import DONE, KNOWN_ERROR, WRONG_USAGE
from depthba.verbs.output import note, print_json
from sim.scenes import SCENES

if TYPE_CHECKING:
    from sim.options import GenerateOptions

_SCENES = (
    f"One of {', '.join(SCENES)}, which --list describes. Or one of your own: an MJCF file"
    " (my/scene.xml), or a Python function of the seed that returns a mujoco.MjSpec"
    " (module:function)."
)


@dataclass(frozen=True)
class Capture:
    """What is captured, and with what."""

    seed: int = 0
    """Arrangement of the scene, noise and pose errors. With --count: the first of the seeds."""
    frames: int | None = None
    """Number of frames. None: the rig's own, see --list."""
    rig: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """What carries the sensor from pose to pose. None: the scene's own, see --list."""
    sensor: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """The depth sensor. None: the scene's own, see --list."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH")] = None
    """Image size in pixels, such as 320x240, with the same horizontal field of view. None: the
    sensor's own."""
    no_rgb: bool = False
    """Render no colour images."""
    settled: bool = False
    """Let loose bodies come to rest under physics before the capture. Takes minutes."""
    renderer: Literal["rays", "mujoco"] = "rays"
    """rays: cast against the scene's triangles, exact, runs everywhere. mujoco: its own OpenGL
    renderer, as a cross-check; needs EGL or OSMesa."""


@dataclass(frozen=True)
class Noise:
    """What the sensor and the rig get wrong."""

    clean: bool = False
    """Leave all noise out, of the depth and of the poses; --start-error still counts."""
    white: bool = False
    """For studies: the sensor's sigma along the ray, in every pixel for itself, no other fault."""
    without: Annotated[tuple[str, ...], tyro.conf.arg(metavar="STAGE ...")] = ()
    """Stages of the sensor's noise to leave out, see --list."""
    stages: bool = False
    """Draw what each stage does to frame 0, too: stages.png in the dataset's folder."""
    pose_noise: float = 1.0
    """Factor on the rig's pose errors."""
    depth_noise: float = 1.0
    """Factor on the errors of the sensor's disparity."""
    start_error: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="M RAD")] = None
    """Instead of the rig's pose errors: independent Gaussian errors per axis with these standard
    deviations, m and rad; frame 0 is exact."""


@dataclass(frozen=True)
class Batch:
    """Many datasets: one for each seed, in folders DIR/<scene>-<seed>.

    Given again, the command goes on where it was stopped. Exit status 1: some could not be made.
    """

    count: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Make this many datasets, in parallel, with the seeds --seed, --seed + 1, and so on."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Processes on this machine. None: as many as it has cores."""
    scheduler: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Instead of this machine: a Dask scheduler, such as tcp://127.0.0.1:8786, whose workers have
    depthba installed and see the same files."""


@dataclass(frozen=True)
class Arguments:
    """Render a dataset of a simulated scene. The truth in it is exact, the faults are the sensor's.

    Equal arguments give equal bytes. A dataset that was cut short is resumed, a finished one left
    as it is.
    """

    scene: Annotated[
        str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SCENE]", help=_SCENES)
    ] = None
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the dataset: new, empty, or holding the same dataset. With --count: the folder of
    the datasets. Needed, but for --list."""
    list: bool = False
    """Show the scenes, rigs, sensors and stages of noise there are, and do nothing else."""
    json: bool = False
    """Print one JSON object on stdout in place of text: path, frames, seconds; with --count: path,
    done, skipped, failed (seed, error), seconds; with --list: what is shown. Metres, pixels."""
    capture: Capture = field(default_factory=Capture)
    noise: Noise = field(default_factory=Noise)
    batch: Batch = field(default_factory=Batch)


def run(arguments: Arguments) -> int:
    """Render what is asked for, say where it is; return the exit status."""
    if arguments.list:
        return _list(arguments.json)
    if arguments.scene is None or arguments.out is None:
        lacks = "SCENE" if arguments.scene is None else "--out DIR"
        note(f"depthba generate: {lacks} is missing; `depthba generate --list` shows the scenes")
        return WRONG_USAGE
    batch = arguments.batch
    if batch.count is None:
        for name, value in (("workers", batch.workers), ("scheduler", batch.scheduler)):
            if value is not None:
                raise OptionError(f"--{name} {value}: expected --count N beside it")
        return _one(arguments, arguments.scene, arguments.out)
    if arguments.noise.stages:
        raise OptionError("--stages: draws one dataset, expected no --count beside it")
    return _many(arguments, arguments.scene, arguments.out, batch.count)


def _list(json: bool) -> int:
    from sim.verbs import listing

    there = listing.describe()
    if json:
        print_json(there)
    else:
        listing.show(there)
    return DONE


def _one(arguments: Arguments, scene: str, out: Path) -> int:
    options = options_of(arguments)
    from depthba.dataset import Dataset
    from sim.generation import draw_stages, generate
    from sim.verbs.progress import FrameProgress

    begin = time.perf_counter()
    with FrameProgress(scene) as progress:
        path = generate(scene, out, options, progress)
        picture = None
        if arguments.noise.stages:
            picture = draw_stages(scene, path / "stages.png", options)
    seconds = time.perf_counter() - begin
    frames = len(Dataset.open(path))
    if arguments.json:
        drawn = {} if picture is None else {"stages": str(picture)}
        print_json({"path": str(path), "frames": frames, "seconds": seconds} | drawn)
        return DONE
    print(f"{scene}: {frames} frames in {seconds:.1f} s\n  dataset       {path}")
    if picture is not None:
        print(f"  stages        {picture}")
    return DONE


def _many(arguments: Arguments, scene: str, out: Path, count: int) -> int:
    options, batch = options_of(arguments), arguments.batch
    from sim.batch import generate_many
    from sim.verbs.progress import BatchProgress, duration

    with BatchProgress(scene) as progress:
        report = generate_many(
            scene, out, count, options, batch.workers, batch.scheduler, progress=progress
        )
    if arguments.json:
        print_json(
            {
                "path": str(out),
                "done": report.done,
                "skipped": report.skipped,
                "failed": [{"seed": f.seed, "error": f.error} for f in report.failed],
                "seconds": report.seconds,
            }
        )
    else:
        there = f", {report.skipped} were there already" if report.skipped else ""
        print(
            f"{scene}: {report.done} datasets in {duration(report.seconds)}{there}\n"
            f"  datasets      {out}"
        )
    if report.failed:
        note(f"depthba: error: {report.line()}")
        return KNOWN_ERROR
    return DONE


def options_of(arguments: Arguments) -> GenerateOptions:
    """The options that the words stand for; OptionError where the size is not WxH."""
    from sim.options import GenerateOptions

    capture, noise = arguments.capture, arguments.noise
    return GenerateOptions(
        seed=capture.seed,
        frames=capture.frames,
        size=None if capture.size is None else parse_size(capture.size),
        start_error=noise.start_error,
        clean=noise.clean,
        pose_noise=noise.pose_noise,
        depth_noise=noise.depth_noise,
        white=noise.white,
        without=noise.without,
        sensor=capture.sensor,
        rig=capture.rig,
        renderer=capture.renderer,
        settled=capture.settled,
        rgb=not capture.no_rgb,
    )


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of `WxH`; OptionError names what was given."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise OptionError(f"size {text!r}: expected width and height in pixels, such as 320x240")
    return int(width), int(height)
