"""The verb `generate`: a scene and a seed in, a dataset with known truth out."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from depthba.errors import OptionError
from depthba.verbs import DONE
from depthba.verbs.output import print_json
from sim.scenes import SCENES

if TYPE_CHECKING:
    from sim.generation import GenerateOptions

_SCENES = "\n".join(f"{scene.id}: {scene.description}." for scene in SCENES.values())


@dataclass(frozen=True)
class Arguments:
    """Render a dataset of a simulated scene. The truth in it is exact, the faults are the sensor's.

    Equal arguments give equal bytes. A dataset that was cut short is resumed.
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE", help=_SCENES)]
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the dataset: new, empty, or holding the same dataset cut short."""
    seed: int = 0
    """Arrangement of the scene, noise and pose errors."""
    frames: int | None = None
    """Number of frames. None: the rig's own (industrial scenes: 21)."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH")] = None
    """Image size in pixels, such as 320x240. None: the sensor's own."""
    start_error: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="M RAD")] = None
    """Instead of the rig's pose errors: independent Gaussian errors per axis with these standard
    deviations, m and rad; frame 0 is exact."""
    clean: bool = False
    """Leave all noise out, of the depth and of the poses; --start-error still counts."""
    pose_noise: float = 1.0
    """Factor on the rig's pose errors."""
    without: tuple[str, ...] = ()
    """Stages of the sensor's noise to leave out: range-noise, range-limits, quantisation."""
    no_rgb: bool = False
    """Render no colour images."""
    json: bool = False
    """Print one JSON object on stdout in place of text: path, frames, seconds."""


def run(arguments: Arguments) -> int:
    """Render the dataset, say where it is; return the exit status."""
    from depthba.dataset import Dataset
    from sim.generation import generate
    from sim.verbs.progress import FrameProgress

    begin = time.perf_counter()
    with FrameProgress(arguments.scene) as progress:
        path = generate(arguments.scene, arguments.out, options_of(arguments), progress)
    seconds = time.perf_counter() - begin
    frames = len(Dataset.open(path))
    if arguments.json:
        print_json({"path": str(path), "frames": frames, "seconds": seconds})
    else:
        print(f"{arguments.scene}: {frames} frames in {seconds:.1f} s\n  dataset       {path}")
    return DONE


def options_of(arguments: Arguments) -> GenerateOptions:
    """The options that the words stand for; OptionError where the size is not WxH."""
    from sim.generation import GenerateOptions

    return GenerateOptions(
        seed=arguments.seed,
        frames=arguments.frames,
        size=None if arguments.size is None else parse_size(arguments.size),
        start_error=arguments.start_error,
        clean=arguments.clean,
        pose_noise=arguments.pose_noise,
        without=arguments.without,
        rgb=not arguments.no_rgb,
    )


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of `WxH`; OptionError names what was given."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise OptionError(f"size {text!r}: expected width and height in pixels, such as 320x240")
    return int(width), int(height)
