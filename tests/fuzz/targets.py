"""What is fuzzed: everything of the project that parses, each with valid files to begin with."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz import mutating
from tests.fuzz.mutating import Mutator

CORPUS = Path(__file__).with_name("corpus")
"""By target: inputs that once went wrong, as small as they could be made."""


@dataclass(frozen=True)
class Target:
    """One parser."""

    name: str
    make: Callable[[Path], object]
    """Makes a valid folder at a path."""
    file: str
    """The file of that folder that inputs take the place of."""
    read: Callable[[Path], object]
    """Reads the folder."""
    mutate: Mutator
    put: Callable[[Path, str, bytes], None] | None = None
    """Puts an input into the folder. None: it is written where the file was."""
    writes: bool = False
    """Whether reading changes the folder, so that each input needs a new one."""
    trusted: bool = False
    """Whether the file may name files anywhere, as what a user writes himself does."""

    def place(self, folder: Path, data: bytes) -> None:
        """Put an input in its place."""
        if self.put is not None:
            self.put(folder, self.file, data)
        else:
            (folder / self.file).write_bytes(data)

    def seeds(self, folder: Path) -> list[bytes]:
        """Return the valid file of a folder that `make` made, and what went wrong before."""
        return [(folder / self.file).read_bytes(), *(p.read_bytes() for p in self.kept())]

    def kept(self) -> list[Path]:
        """Return the corpus of this target."""
        return sorted(CORPUS.glob(f"{self.name}/*"))


def target(name: str) -> Target:
    """Return the target of a name."""
    return {t.name: t for t in targets()}[name]


def targets() -> tuple[Target, ...]:
    """Return all targets."""
    from tests.fuzz import controller_targets, convert_targets

    return (*_DATASET, *_RUN, *_SESSION, *convert_targets.TARGETS, *controller_targets.TARGETS)


# Datasets

WIDTH, HEIGHT = 8, 6


def _pose(k: int) -> Any:
    from depthba import se3

    return se3.make(se3.exp_so3([3.0 + 0.05 * k, 0.1, 0.0]), [0.05 * k, 0.0, 1.0])


def depth_set(path: Path, frames: int = 3, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    """Write depth images with colour, truth, markers and a calibration."""
    from depthba.dataset import DatasetWriter, Marker

    width, height = size
    sensor: dict[str, Any] = {"kind": "depth", "width": width, "height": height, "fx": 7.0}
    sensor |= {"fy": 7.5, "cx": width / 2, "cy": height / 2, "depth_scale": 0.001}
    sensor |= {"depth_min": 0.1, "noise": {"sigma_m": 0.001, "power": 2}}
    noise = {"sigma_t_m": [0.1] * 3, "sigma_r_rad": [0.1] * 3}
    header = {"name": "small", "sensor": sensor, "seed": 3, "pose_noise": noise}
    writer = DatasetWriter.create(path, {**header, "T_flange_camera": np.eye(4).tolist()})
    for k in range(frames):
        writer.add_frame(
            stamp=0.5 * k,
            depth=1.0 + 0.01 * np.arange(width * height).reshape(height, width),
            rgb=np.full((height, width, 3), 40 * k, np.uint8),
            T_world_camera=_pose(k),
            T_world_camera_true=_pose(k),
            joints=[0.1] * 6,
            T_base_flange=np.eye(4),
        )
    writer.write_markers([Marker("origin", np.zeros(3), ((0, np.array([0.1, 0.2, 1.0])),))])
    board = {"kind": "chessboard", "columns": 9, "rows": 6, "square_m": 0.03}
    (path / "calibration.json").write_text(
        json.dumps({"board": board, "T_flange_camera_true": np.eye(4).tolist()})
    )


def cloud_set(path: Path) -> None:
    """Write clouds."""
    from depthba.dataset import DatasetWriter

    writer = DatasetWriter.create(path, {"sensor": {"kind": "cloud", "origin": True}})
    for k in range(2):
        points = np.random.default_rng(k).uniform(0.5, 1.0, (20, 3))
        writer.add_frame(stamp=0.5 * k, cloud=points, T_world_camera=_pose(k))


def read_dataset(path: Path) -> None:
    """Read all there is in a dataset, as `Dataset` and as `doctor` do."""
    from depthba.dataset import Dataset, verify

    verify(path)
    dataset = Dataset.open(path)
    dataset.T_world_camera_true  # noqa: B018
    dataset.markers()
    dataset.calibration()
    for frame in dataset.frames[:4]:
        if frame.files.keys() & {"depth"}:
            frame.depth()
            frame.rgb()
        else:
            frame.points()


def _resume(path: Path) -> None:
    from depthba.dataset import DatasetWriter

    DatasetWriter.resume(path)


def _listed(folder: Path, file: str, data: bytes) -> None:
    """Put a file of frame 0, whose sum frames.jsonl then has."""
    (folder / file).write_bytes(data)
    first, *others = (folder / "frames.jsonl").read_text().splitlines()
    record = json.loads(first)
    record["sha256"][file.partition("/")[0]] = hashlib.sha256(data).hexdigest()
    lines = [json.dumps(record), *others]
    (folder / "frames.jsonl").write_text("".join(line + "\n" for line in lines))


def _masked(folder: Path) -> None:
    from depthba.dataset import Dataset

    Dataset.open(folder).masked(folder / "depth/000000.png")


def _dataset(name: str, file: str, mutate: Mutator, **more: Any) -> Target:
    return Target(name, depth_set, file, read_dataset, mutate, **more)


_DATASET = (
    _dataset("dataset-header", "dataset.json", mutating.of_json),
    _dataset("dataset-frames", "frames.jsonl", mutating.of_lines),
    _dataset("dataset-poses", "poses_measured.txt", mutating.of_text),
    _dataset("dataset-truth", "poses_true.txt", mutating.of_text),
    _dataset("dataset-markers", "markers.json", mutating.of_json),
    _dataset("dataset-calibration", "calibration.json", mutating.of_json),
    _dataset("dataset-depth", "depth/000000.png", mutating.of_png, put=_listed),
    _dataset("dataset-rgb", "rgb/000000.png", mutating.of_png, put=_listed),
    Target("dataset-cloud", cloud_set, "cloud/000000.ply", read_dataset, mutating.of_ply, _listed),
    Target("dataset-resume", depth_set, "frames.jsonl", _resume, mutating.of_lines, writes=True),
    Target("mask", depth_set, "depth/000000.png", _masked, mutating.of_png),
)


# Runs


def run_folder(path: Path) -> None:
    """Write a run of three frames."""
    from depthba import run_folder as folders
    from depthba import se3, trajectory
    from depthba.depth_map import DepthMap

    depth_set(path / "set")
    y, x = np.mgrid[0:10, 0:12]
    seen = np.ones(x.shape, np.int64)
    heights = DepthMap(0.01 * x + 0.02 * y, (0.0, 0.0), 0.02, np.eye(4), seen, 1e-3 * seen)
    poses = np.array([_pose(k) for k in range(3)])
    stamps = np.arange(3.0)
    trajectory.write_tum(path / "poses.txt", stamps, poses)
    trajectory.write_tum(path / "poses_start.txt", stamps, se3.retract(poses, np.full(6, 1e-3)))
    (path / "map.npz").write_bytes(folders.map_bytes(heights))
    (path / "map_start.npz").write_bytes(folders.map_bytes(heights))
    (path / "covariance.npz").write_bytes(folders.covariance_bytes(np.eye(18)))
    (path / "config.yaml").write_text(
        "preset: default\nresolution: 0.02\nroi: [0, 1, 0, 1, 0, 1]\n"
    )
    metric = {"a": {"value": 1.0, "unit": "m", "better": "lower"}}
    (path / "metrics.json").write_text(json.dumps({"metrics": metric, "start": metric}))
    (path / "result.json").write_text(json.dumps(_RESULT))


_RESULT: dict[str, Any] = {
    "format": "depthba-run",
    "version": 1,
    "name": "small",
    "status": "weak",
    "trusted": False,
    "reason": "yaw is open",
    "iterations": 1,
    "seconds": {"total": 1.0},
    "sigma": 1e-3,
    "inflation": 2.0,
    "fixed_pattern": None,
    "dataset": {"path": "small", "name": "small", "frames": 3, "seed": 1, "map_frame": "world",
                "truth": True},
    "options": {},
    "map": {"spacing": 0.02, "nx": 12, "ny": 10},
    "weak": [{"frame": 1, "name": "yaw", "direction": [0, 0, 0, 0, 0, 1.0], "lever": 0.4,
              "sigma": 0.05, "prior_sigma": 0.02}],
    "frames": [{"frame": k, "points": 700, "overlap": 0.9, "inliers": 0.8, "move_t": 1e-3,
                "move_r": 2e-3, "held": ""} for k in range(3)],
    "overlap": [[1.0]],
    "history": [],
    "versions": {"python": "3.11"},
}  # fmt: skip


def read_run(path: Path) -> None:
    """Read a run as `evaluate` and `review` do."""
    from depthba.dataset import Dataset
    from depthba.stored_run import Run
    from eval import rebuild

    run = Run.open(path)
    rebuild.archived_options(run)
    rebuild.archived_metrics(path)
    rebuild.archived_result(run, Dataset.open(path / "set"))


def _read_config(path: Path) -> None:
    from depthba.verbs.arguments import _read
    from depthba.verbs.register import Arguments

    _read(str(path / "config.yaml"), Arguments)


def _outcome(path: Path) -> None:
    """Write the outcome of a method."""
    from eval.benchmark.outcome import Outcome

    path.mkdir()
    Outcome(
        key="k", dataset="d", group="g", seed=1, method="m", status="done", limits={"seconds": 1.0}
    ).write(path)


def _read_outcome(path: Path) -> None:
    from eval.benchmark import outcome

    outcome.read(path)


def _run(file: str, mutate: Mutator) -> Target:
    name = f"run-{file.partition('.')[0]}"
    return Target(name, run_folder, file, read_run, mutate)


_RUN = (
    _run("result.json", mutating.of_json),
    _run("config.yaml", mutating.of_yaml),
    _run("metrics.json", mutating.of_json),
    _run("poses.txt", mutating.of_text),
    _run("map.npz", mutating.of_npz),
    _run("covariance.npz", mutating.of_npz),
    Target("options", run_folder, "config.yaml", _read_config, mutating.of_yaml),
    Target("outcome", _outcome, "outcome.json", _read_outcome, mutating.of_json),
)


# Sessions

SESSIONS = Path(__file__).parents[2] / "docs" / "sessions"


def sessions(path: Path) -> None:
    """Copy the examples of the documentation."""
    shutil.copytree(SESSIONS, path)
    (path / "session.yaml").write_bytes((path / "ur_zed.yaml").read_bytes())
    deltas = ", ".join(["1e-5"] * 6)
    names = ("theta", "a", "d", "alpha")
    conf = "".join(f"delta_{name} = [ {deltas} ]\n" for name in names)
    (path / "calibration.conf").write_text(f"[mounting]\n{conf}")
    (path / "calibration.yaml").write_text(conf.replace(" =", ":"))


def read_session(path: Path) -> None:
    """Read a session and the files it names."""
    from rig.session import reading

    session = reading.read_session(path / "session.yaml")
    for poses in session.poses:
        if poses.taught is not None:
            reading.read_taught(poses.taught, 6, degrees=False)


def _gantry(path: Path) -> None:
    sessions(path)
    (path / "session.yaml").write_bytes((path / "gantry_genicam.yaml").read_bytes())


def _record(path: Path) -> None:
    from depthba.dataset import Dataset
    from rig.hand_eye.record import HandEyeRecord, Open, head, write_content

    depth_set(path)
    opened = (Open("z", np.eye(6)[2], 0.5),)
    record = HandEyeRecord(
        "board", "eye-in-hand", "good", True, "well", np.eye(4), np.eye(6), opened
    )
    write_content(head(record, Dataset.open(path)), path)


def _read_record(path: Path) -> None:
    from depthba.errors import OptionError
    from rig.hand_eye.record import read_record, read_transform

    try:
        read_record(path / "hand_eye.json", "--from")
    except OptionError:
        read_transform(path / "hand_eye.json")


def _read_taught(path: Path) -> None:
    from rig.session.reading import read_taught

    read_taught(path / "taught.txt", 6, degrees=True)


def _calibration(file: str) -> Callable[[Path], object]:
    def read(path: Path) -> None:
        from depthba.ur_calibration import read_calibration

        read_calibration(path / file)

    return read


_SESSION = (
    Target("session", sessions, "session.yaml", read_session, mutating.of_yaml, trusted=True),
    Target("session-gantry", _gantry, "session.yaml", read_session, mutating.of_yaml, trusted=True),
    Target("session-hand-eye", sessions, "hand_eye.json", read_session, mutating.of_json),
    Target("session-taught", sessions, "taught.txt", _read_taught, mutating.of_text),
    Target("hand-eye", _record, "hand_eye.json", _read_record, mutating.of_json),
    Target(
        "arm-calibration",
        sessions,
        "calibration.conf",
        _calibration("calibration.conf"),
        mutating.of_text,
    ),
    Target(
        "arm-calibration-yaml",
        sessions,
        "calibration.yaml",
        _calibration("calibration.yaml"),
        mutating.of_yaml,
    ),
)


def names() -> Iterable[str]:
    """Return the names of all targets."""
    return [t.name for t in targets()]
