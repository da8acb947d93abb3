"""frames.jsonl and poses_*.txt: which frames there are, and where each was."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba.dataset import fields
from depthba.dataset.faults import Faults, MalformedError
from depthba.dataset.model import Frame, StoredFile
from depthba.errors import DatasetError
from depthba.trajectory import Trajectory, parse_tum, read_text

Array = NDArray[np.float64]

FILE = "frames.jsonl"
_STRANGE = re.compile(r"[\\\x00-\x1f]|^[A-Za-z]:")
"""In a path: what separates or names a drive on Windows, and what no name should have."""
STAMP_TOLERANCE = 1e-6
"""Stamps that differ by no more are the same, seconds."""


@dataclass(frozen=True, eq=False)
class Entry:
    """One line of frames.jsonl, checked; no file has been touched."""

    line: str
    id: int
    stamp: float
    files: Mapping[str, StoredFile]
    joints: Array | None
    T_base_flange: Array | None
    record: Mapping[str, Any]


def pose_file(name: str) -> str:
    """Return the file of the poses ``name``, such as ``measured``."""
    return f"poses_{name}.txt"


def read_entries(root: Path, kind: str | None, faults: Faults) -> tuple[list[Entry], list[str]]:
    """Return the frames of frames.jsonl, and warnings; ``kind`` is the sensor's, if known."""
    try:
        lines = _lines(root / FILE)
    except DatasetError as error:
        if faults.strict:
            raise
        faults.add(FILE, None, str(error).removeprefix(f"{root / FILE}: "))
        return [], []
    entries: list[Entry] = []
    warnings: list[str] = []
    unterminated = lines.pop()
    for index, line in enumerate([*lines, unterminated]):
        if not line.strip():
            continue
        last = index == len(lines)
        try:
            record = fields.mapping(fields.parse(_decoded(line)), "it")
        except MalformedError as error:
            if last:
                shown = line[:60].decode(errors="replace")
                warnings.append(
                    f"{root / FILE}: line {index + 1}: dropped the truncated last line {shown!r}"
                )
            else:
                faults.add(FILE, None, f"line {index + 1}: {error}")
            continue
        entry = _entry(root, _decoded(line), index + 1, record, kind, faults)
        if entry is not None:
            _check_order(entry, entries, index + 1, faults)
            entries.append(entry)
    _check_stamps(entries, faults)
    return entries, warnings


def read_poses(root: Path, name: str, faults: Faults) -> Trajectory | None:
    """Return poses_<name>.txt; None where it cannot be read."""
    file = pose_file(name)
    try:
        text = read_text(root / file)
    except DatasetError as error:
        if faults.strict:
            raise
        faults.add(file, None, str(error).removeprefix(f"{root / file}: "))
        return None
    return parse_tum(text, lambda line, fault: faults.add(file, None, f"line {line}: {fault}"))


def rows_of(stamps: Sequence[float], trajectory: Trajectory) -> list[NDArray[np.int64]]:
    """Return for each stamp the indices of the poses that have it: one, if all is well."""
    order = np.argsort(trajectory.stamps, kind="stable")
    known = trajectory.stamps[order]
    wanted = np.asarray(stamps, dtype=np.float64)
    # Seconds since 1970 come in steps of 2e-7, so the tolerance grows by a few steps.
    tolerance = STAMP_TOLERANCE + 4 * np.spacing(np.abs(wanted))
    first = np.searchsorted(known, wanted - tolerance, side="left")
    end = np.searchsorted(known, wanted + tolerance, side="right")
    return [order[a:b] for a, b in zip(first, end, strict=True)]


def join(
    frames: Sequence[Entry | Frame], trajectory: Trajectory, name: str, faults: Faults
) -> Array:
    """Return the pose of each frame, (N, 4, 4); NaN where a fault was reported instead."""
    poses = np.full((len(frames), 4, 4), np.nan)
    file = pose_file(name)
    rows = rows_of([frame.stamp for frame in frames], trajectory)
    for i, (frame, row) in enumerate(zip(frames, rows, strict=True)):
        if len(row) == 1:
            poses[i] = trajectory.T_world_camera[row[0]]
            continue
        found = "no pose" if len(row) == 0 else f"{len(row)} poses"
        near = ""
        if len(row) == 0 and len(trajectory.stamps):
            gaps = np.abs(trajectory.stamps - frame.stamp)
            near = f" (the nearest is at {trajectory.stamps[np.argmin(gaps)]:.9f})"
        text = f"{found} with stamp {frame.stamp:.9f}, expected one to {STAMP_TOLERANCE:g} s{near}"
        faults.add(file, frame.id, text)
    return poses


def inside(root: Path, path: str) -> None:
    """Refuse a path that leaves the dataset, by its text or through a link."""
    pure = PurePosixPath(path)
    if not path or pure.is_absolute() or ".." in pure.parts or _STRANGE.search(path):
        raise MalformedError(
            f"path {fields.shown(path)}, expected one inside the dataset, relative, without '..'"
        )
    try:
        target = (root / path).resolve()
        home = root.resolve()
    except (OSError, RuntimeError) as error:
        raise MalformedError(f"path {fields.shown(path)} cannot be followed: {error}") from error
    if not target.is_relative_to(home):
        raise MalformedError(
            f"path {fields.shown(path)} is a link out of the dataset, expected one inside"
        )


def _lines(path: Path) -> list[bytes]:
    """Return the lines as bytes: a crash can leave what is not even text."""
    try:
        return path.read_bytes().split(b"\n")
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file, expected one line per frame") from None
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror}, expected a readable file") from error


def _decoded(line: bytes) -> str:
    try:
        return line.decode()
    except UnicodeDecodeError as error:
        raise MalformedError(f"byte {error.start} is not UTF-8, expected JSON") from error


def _entry(
    root: Path, line: str, number: int, record: dict[str, Any], kind: str | None, faults: Faults
) -> Entry | None:
    """Check one line, every part on its own, so that all faults come out at once."""
    frame: int | None = None
    stamp: float | None = None
    with faults.within(FILE, None):
        try:
            frame = fields.integer(fields.required(record, "id"), "id")
        except MalformedError as error:
            raise MalformedError(f"line {number}: {error}") from error
    with faults.within(FILE, frame):
        stamp = fields.number(fields.required(record, "stamp"), "stamp")
    joints, T_base_flange = None, None
    with faults.within(FILE, frame):
        if record.get("joints") is not None:
            joints = np.array(fields.numbers(record["joints"], "joints"))
            joints.setflags(write=False)
    with faults.within(FILE, frame):
        if record.get("T_base_flange") is not None:
            T_base_flange = fields.rigid(record["T_base_flange"], "T_base_flange")
    files = _files(root, record, kind, frame, faults)
    if frame is None or stamp is None:
        return None
    return Entry(line, frame, stamp, files, joints, T_base_flange, record)


def _files(
    root: Path, record: dict[str, Any], kind: str | None, frame: int | None, faults: Faults
) -> dict[str, StoredFile]:
    if kind is None:
        kind = "cloud" if "cloud" in record else "depth"
    files: dict[str, StoredFile] = {}
    hashes: dict[str, Any] = {}
    with faults.within(FILE, frame):
        hashes = fields.mapping(fields.required(record, "sha256"), "sha256")
    for name in ("cloud",) if kind == "cloud" else ("depth", "rgb"):
        if name == "rgb" and record.get("rgb") is None:
            continue
        with faults.within(FILE, frame):
            path = fields.text(fields.required(record, name), name)
            inside(root, path)
            if name not in hashes:
                raise MalformedError(f"sha256 of {name!r} is missing")
            files[name] = StoredFile(path, _sha256(hashes[name], f"sha256.{name}"))
    return files


def _sha256(value: Any, name: str) -> str:
    digest = fields.text(value, name).lower()
    if len(digest) != 64 or set(digest) - set("0123456789abcdef"):
        raise MalformedError(f"{name} is {fields.shown(value)}, expected 64 hexadecimal digits")
    return digest


def _check_order(entry: Entry, entries: list[Entry], number: int, faults: Faults) -> None:
    """Ids are unique and rise."""
    if entries and entry.id <= entries[-1].id:
        twice = any(entry.id == other.id for other in entries)
        what = "is there twice" if twice else f"follows id {entries[-1].id}"
        faults.add(FILE, entry.id, f"line {number}: id {entry.id} {what}, expected ids that rise")


def _check_stamps(entries: Sequence[Entry], faults: Faults) -> None:
    """No two frames share a stamp, else they would share a pose."""
    in_time = sorted(entries, key=lambda entry: entry.stamp)
    for one, other in pairwise(in_time):
        if other.stamp - one.stamp <= STAMP_TOLERANCE:
            text = f"stamp {other.stamp:.9f} is that of frame {one.id} too, expected one of its own"
            faults.add(FILE, other.id, text)
