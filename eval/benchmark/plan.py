"""What a benchmark runs: its options, its datasets, and the work that they make."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import depthba
from depthba.errors import OptionError
from eval.methods import METHODS, entry, in_order

if TYPE_CHECKING:
    from sim.options import GenerateOptions

LABS = ("lab-1", "lab-2", "lab-3")
BAYS = ("industrial-4", "industrial-5", "industrial-6")
WIDTH = 320
"""Of the images, pixels, where none is asked for: a quarter of the sensors' own."""
QUICK_SIZE = (160, 120)
QUICK_FRAMES = 8
QUICK_METHODS = (
    "initial", "teaser", "teaser-icp", "balm2-fine", "gicp-pgo", "depthba-paper", "depthba",
)  # fmt: skip
STUDIES: dict[str, tuple[float, ...]] = {
    "start": (0.25, 0.5, 1.0, 2.0, 4.0, 8.0),
    "noise": (0.5, 1.0, 2.0, 4.0),
    "frames": (6.0, 11.0, 16.0, 21.0),
    "overlap": (12.0, 15.0, 21.0, 28.0),
    "resolution": (160.0, 240.0, 320.0, 480.0),
}
"""What a study varies, and its values: factor on the start error, factor on the depth noise, first
frames of the capture that are taken, frames that cover the same ground, width of the images."""


@dataclass(frozen=True)
class Case:
    """One dataset of a benchmark."""

    name: str
    """Unique in the benchmark: a folder."""
    group: str
    """What its seeds have in common."""
    seed: int | None
    path: Path
    """Where the dataset is, or will be."""
    scene: str | None = None
    """The scene to generate it from; None: it is there."""
    options: GenerateOptions | None = None
    first: int | None = None
    """Take this many frames, the first ones; None: all."""
    varied: tuple[str, float] | None = None
    """Name and value of what a study varies."""


@dataclass(frozen=True)
class Job:
    """All methods on one dataset, one after the other: those that share pairs find them there."""

    case: Case
    methods: tuple[str, ...]
    out: Path
    """Folder of the benchmark."""
    threads: int
    seconds: float
    """After which a method is stopped."""
    memory: float
    """Bytes above which a method is stopped."""

    def folder(self, method: str) -> Path:
        """Return where a method's poses and outcome go."""
        return self.out / self.case.name / method

    def key(self, method: str) -> str:
        """Name what an outcome depends on, but for the limits."""
        case = self.case
        options = None if case.options is None else asdict(case.options)
        said: dict[str, Any] = {
            "depthba": depthba.__version__,
            "method": method,
            "scene": case.scene,
            "options": options,
            "path": None if case.scene is not None else str(case.path.resolve()),
            "files": None if case.scene is not None else _fingerprint(case.path),
            "first": case.first,
        }
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:16]


def methods_of(text: str | None) -> tuple[str, ...]:
    """Return the methods named in ``A,B``, in the order of the tables; None: all of ours.

    Raises:
        OptionError: one is unknown.

    """
    if text is None:
        return tuple(METHODS)
    asked = [name.strip() for name in text.split(",") if name.strip()]
    for name in asked:
        entry(name)
    if not asked:
        raise OptionError(f"--methods {text!r}: names none; choose from: {', '.join(METHODS)}")
    return tuple(in_order(asked))


def given_cases(paths: Sequence[Path]) -> list[Case]:
    """Return the cases of dataset folders that are there.

    Raises:
        OptionError: a folder is missing.

    """
    cases: list[Case] = []
    for path in paths:
        if not (path / "dataset.json").is_file():
            raise OptionError(f"--datasets {path}: no dataset there, expected a dataset.json in it")
        stem = path.resolve().name
        taken = {case.name for case in cases}
        name = next(
            n for k in range(len(cases) + 1) if (n := f"{stem}-{k}" if k else stem) not in taken
        )
        cases.append(Case(name, name, None, path))
    return cases


def scene_cases(
    scenes: Sequence[str],
    seeds: int,
    out: Path,
    start_error: tuple[float, float] | None,
    size: tuple[int, int] | None = None,
    frames: int | None = None,
) -> list[Case]:
    """Return the cases of simulated scenes, ``seeds`` of each, generated below ``out``.

    Raises:
        OptionError: a scene is unknown, or the number of seeds makes no sense.

    """
    from sim.options import GenerateOptions
    from sim.scenes import SCENES

    if seeds < 1:
        raise OptionError(f"--seeds {seeds}: expected 1 or more, it is how many seeds are taken")
    cases = []
    for scene in scenes:
        if scene not in SCENES:
            raise OptionError(f"--scenes {scene}: unknown; choose from: {', '.join(SCENES)}")
        for seed in range(seeds):
            options = GenerateOptions(
                seed=seed,
                frames=frames,
                size=size or usual_size(scene),
                start_error=start_error,
                rgb=False,
            )
            name = f"{scene}-{seed}"
            cases.append(Case(name, scene, seed, out / "data" / name, scene, options))
    return cases


def study_cases(study: str, scene: str, seeds: int, out: Path) -> list[Case]:
    """Return the cases of a study: a scene at several values of one thing."""
    cases = []
    for value in STUDIES[study]:
        for case in scene_cases([scene], seeds, out, START):
            made = _varied(case, study, value)
            name = f"{scene}-{study}-{value:g}-{case.seed}"
            path = case.path if made.options == case.options else out / "data" / name
            cases.append(
                replace(
                    made,
                    name=name,
                    group=f"{scene}, {study} {value:g}",
                    path=path,
                    varied=(study, value),
                )
            )
    return cases


START = (0.01, 0.02)
"""Standard deviations of the start poses in the paper's tables, m and rad."""


def _varied(case: Case, study: str, value: float) -> Case:
    options = case.options
    assert options is not None and options.size is not None
    if study == "start":
        options = replace(options, start_error=(value * START[0], value * START[1]))
    elif study == "noise":
        options = replace(options, depth_noise=value)
    elif study == "frames":
        return replace(case, first=int(value))
    elif study == "overlap":
        options = replace(options, frames=int(value))
    elif study == "resolution":
        assert options.size is not None
        width, height = options.size
        options = replace(options, size=(int(value), round(height * value / width)))
    return replace(case, options=options)


def usual_size(scene: str) -> tuple[int, int]:
    """Return the size of the images, in the proportions of the scene's sensor."""
    from sim.capture import sensor_of
    from sim.options import GenerateOptions
    from sim.scenes import find_scene

    camera = sensor_of(find_scene(scene), GenerateOptions()).camera
    return WIDTH, round(WIDTH * camera.height / camera.width)


def _fingerprint(path: Path) -> str:
    digest = hashlib.sha256()
    for name in ("dataset.json", "frames.jsonl", "poses_measured.txt", "poses_true.txt"):
        file = path / name
        digest.update(file.read_bytes() if file.is_file() else b"-")
    return digest.hexdigest()
