"""What a session leaves in its dataset besides frames, so that it can go on after anything.

dataset.json holds the session and the plan under ``source``, written with the first byte of the
dataset; a frame's line in frames.jsonl holds its ``station``; skipped.jsonl has a line for each
station that was given up, written before the next is gone to.
"""

from __future__ import annotations

import datetime
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import __version__, durable
from depthba.dataset import Dataset, DatasetWriter
from depthba.dataset.extras import CALIBRATION
from depthba.dataset.faults import Faults
from depthba.dataset.header import read_header
from depthba.documents import parse_json
from depthba.errors import DatasetError, OptionError
from rig.cameras.camera import CameraInfo
from rig.session.options import Session, plain
from rig.session.planning import Plan
from rig.session.workspace import Workspace

Array = NDArray[np.float64]

TOOL = "depthba capture"
SKIPPED = "skipped.jsonl"


@dataclass(frozen=True)
class Skipped:
    """A station without a frame."""

    station: int
    label: str
    reason: str


@dataclass(frozen=True)
class Progress:
    """How far a dataset is."""

    taken: frozenset[int]
    """Stations with a frame."""
    skipped: tuple[Skipped, ...]


def as_stored(session: Session, space: Workspace, rehearsed: bool) -> dict[str, Any]:
    """What must not change while a session is under way: its file's content, and the kinematics."""
    stored: dict[str, Any] = plain(session)
    arm = space.body.arm
    if arm is not None:
        # The parameters themselves tell more than the name of the file they come from.
        names = ("a", "d", "alpha", "theta")
        stored["kinematics"] = {name: list(getattr(arm, name)) for name in names}
    stored["rehearsal"] = stored["rehearsal"] if rehearsed else None
    return stored


def differences(before: Any, now: Any, key: str = "") -> list[str]:
    """What differs between two plain values, a line each: the key, before and now."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        found = []
        for name in dict.fromkeys([*before, *now]):
            inner = f"{key}.{name}" if key else str(name)
            found += differences(before.get(name), now.get(name), inner)
        return found
    if isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = enumerate(zip(before, now, strict=True))
        return [line for k, (a, b) in pairs for line in differences(a, b, f"{key}[{k}]")]
    return [] if before == now else [f"{key}: {_short(before)} before, {_short(now)} now"]


def begin(
    path: Path,
    session: Session,
    space: Workspace,
    plan: Plan,
    info: CameraInfo,
    rehearsed: bool,
) -> DatasetWriter:
    """Begin the dataset in a folder that is not there, or empty."""
    header: dict[str, Any] = {
        "name": session.name or path.resolve().name,
        "created": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "sensor": _sensor(info),
        "map_frame": session.map_frame,
        "T_flange_camera": np.array(session.hand_eye).tolist(),
        "source": {
            "tool": TOOL,
            "version": __version__,
            "camera": {"serial": info.serial, "settings": plain(info.settings)},
            "session": as_stored(session, space, rehearsed),
            "plan": {
                "joints": plan.joints.tolist(),
                "labels": list(plan.labels),
                "left_out": [list(entry) for entry in plan.left_out],
            },
        },
    }
    if session.pose_noise is not None:
        header["pose_noise"] = plain(session.pose_noise)
    writer = DatasetWriter.create(path, header)
    write_board(writer, session)
    return writer


def write_board(writer: DatasetWriter, session: Session) -> None:
    """Write calibration.json where the session looks at a board and there is none yet."""
    if session.board is not None and not (writer.path / CALIBRATION).exists():
        writer.write_calibration({"board": session.board.json()})


def stored_plan(path: Path, session: Session, space: Workspace, rehearsed: bool) -> Plan:
    """The plan of a dataset that this session began.

    Raises:
        DatasetError: the dataset was made by something else, or is no dataset.
        OptionError: the session has changed since; lists all that differs.
    """
    # the header alone: a frame whose file was taken away since is for resuming to make good
    found = read_header(path, Faults(path))
    assert found is not None  # strict faults raise
    source = found.raw.get("source")
    if not isinstance(source, Mapping) or source.get("tool") != TOOL or "plan" not in source:
        raise DatasetError(
            f"{path}: a dataset that no capture session began, expected none or one of this session"
        )
    # As JSON has it, so that a number that was written and read compares with itself.
    now = json.loads(json.dumps(as_stored(session, space, rehearsed)))
    if changed := differences(source["session"], now):
        raise OptionError(
            f"{path}: was begun with another session, expected the same one or a new folder:"
            f" {'; '.join(changed)}"
        )
    joints = np.array(source["plan"]["joints"], float)
    return Plan(
        joints,
        tuple(source["plan"]["labels"]),
        space.camera_at(joints),
        tuple((label, reason) for label, reason in source["plan"]["left_out"]),
    )


def resume(path: Path, info: CameraInfo) -> DatasetWriter:
    """Go on with a dataset; OptionError lists how the camera differs from the one before."""
    writer = DatasetWriter.resume(path)
    before = Dataset.open(path).header
    now = json.loads(json.dumps(_sensor(info)))
    changed = differences(before["sensor"], now, "sensor")
    serial = before["source"]["camera"]["serial"]
    # A simulated camera is called after the address of its controller.
    if serial != info.serial and not serial.startswith("simulated-"):
        changed.append(f"camera.serial: {serial} before, {info.serial} now")
    if changed:
        raise OptionError(
            f"{path}: was begun with another camera, expected the same one or a new folder:"
            f" {'; '.join(changed)}"
        )
    return writer


def progress(path: Path) -> Progress:
    """How far a dataset is, which must have been resumed before."""
    dataset = Dataset.open(path)
    taken = frozenset(int(frame.record["station"]) for frame in dataset)
    skipped = tuple(entry for entry in _read_skipped(path) if entry.station not in taken)
    return Progress(taken, skipped)


def note_skipped(path: Path, entry: Skipped) -> None:
    """Write down that a station was given up; DatasetError where the disk refuses."""
    _finish_line(path / SKIPPED)
    line = {"station": entry.station, "label": entry.label, "reason": entry.reason}
    try:
        durable.append_line(path / SKIPPED, json.dumps(line | {"at": time.time()}))
    except OSError as error:
        raise DatasetError(f"{path / SKIPPED}: {error.strerror or error}") from error


def _read_skipped(path: Path) -> list[Skipped]:
    """A last line that a power cut left half written does not count."""
    try:
        lines = (path / SKIPPED).read_text(encoding="utf-8", errors="replace").split("\n")
    except FileNotFoundError:
        return []
    found = {}
    for line in lines[:-1]:
        try:
            raw = parse_json(line)
            station, label, reason = int(raw["station"]), str(raw["label"]), str(raw["reason"])
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(
                f"{path / SKIPPED}: {line[:60]!r}, expected a pose that was skipped"
            ) from error
        found[station] = Skipped(station, label, reason)
    return [found[station] for station in sorted(found)]


def _finish_line(file: Path) -> None:
    """Take half a last line away, so that the next one is not glued to it."""
    if not file.exists():
        return
    data = file.read_bytes()
    if data and not data.endswith(b"\n"):
        durable.write_bytes(file, data[: data.rfind(b"\n") + 1])


def _sensor(info: CameraInfo) -> dict[str, Any]:
    sensor: dict[str, Any] = {
        "kind": "depth",
        "model": info.model,
        **info.camera.json(),
        "depth_scale": info.depth_scale,
    }
    for name in ("depth_min", "depth_max"):
        if getattr(info, name) is not None:
            sensor[name] = getattr(info, name)
    if info.noise is not None:
        sigma_m, at_m, power = info.noise
        sensor["noise"] = {
            "sigma_m": sigma_m,
            "at_m": at_m,
            "power": power,
            "along": info.noise_along,
        }
    return sensor


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
