"""After a crash: which frames are whole, and putting the rest out of the way without losing it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from depthba import durable
from depthba.dataset import extras, loading
from depthba.dataset.faults import Faults, MalformedError
from depthba.dataset.listing import FILE, Entry, pose_file, read_entries, read_poses, rows_of
from depthba.errors import DatasetError
from depthba.trajectory import Trajectory


def recover(root: Path, kind: str, pose_comment: str) -> tuple[list[Entry], bool | None, list[str]]:
    """Bring the dataset ``root`` back to its longest whole prefix.

    Returns the frames kept, whether they have truth (None: there are none to tell), and what was
    dropped.
    """
    faults = Faults(root)
    if not (root / FILE).exists():
        _refuse_lost_listing(root, kind)
        durable.write_text(root / FILE, "")
    entries, warnings = read_entries(root, kind, faults)
    poses: dict[str, Trajectory] = {}
    for name in ("measured", "true"):
        if (root / pose_file(name)).exists():
            trajectory = read_poses(root, name, faults)
            assert trajectory is not None  # strict faults raise
            poses[name] = trajectory
            warnings += [f"{root / pose_file(name)}: {text}" for text in trajectory.warnings]
    _remove_parts(root)
    whole, reason = _whole(root, entries, poses)
    kept, dropped = entries[:whole], entries[whole:]
    if dropped:
        aside = _set_aside(root, kept, dropped, poses)
        ids = f"frame {dropped[0].id}"
        if len(dropped) > 1:
            ids = f"{len(dropped)} frames from {dropped[0].id} to {dropped[-1].id}"
        warnings.append(f"{root}: dropped {ids} ({reason}), set aside in {aside.name}")
    _rewrite(root / FILE, [entry.line for entry in kept])
    for name, trajectory in poses.items():
        warnings += _rewrite_poses(root, name, trajectory, kept, dropped)
    if "measured" not in poses:
        durable.write_text(root / pose_file("measured"), pose_comment + "\n")
    if not kept and "true" in poses:
        (root / pose_file("true")).unlink()  # frames to come may have no truth
        durable.sync_folder(root)
    return kept, ("true" in poses) if kept else None, warnings


def _whole(root: Path, entries: Sequence[Entry], poses: dict[str, Trajectory]) -> tuple[int, str]:
    """Return how many frames from the first are whole, and what is wrong with the next."""
    stamps = [entry.stamp for entry in entries]
    rows = {name: rows_of(stamps, trajectory) for name, trajectory in poses.items()}
    for i, entry in enumerate(entries):
        for stored in entry.files.values():
            try:
                loading.load_bytes(root / stored.path, stored.sha256)
            except MalformedError as error:
                return i, f"{stored.path}: frame {entry.id}: {error}"
        for name in {"measured", *poses}:
            if name not in rows or len(rows[name][i]) != 1:
                return i, f"{pose_file(name)}: frame {entry.id} has no pose of its own"
    return len(entries), ""


def _set_aside(
    root: Path, kept: Sequence[Entry], dropped: Sequence[Entry], poses: dict[str, Trajectory]
) -> Path:
    """Move the files of dropped frames, with their lines, where no new frame overwrites them."""
    number = 1
    while (root / f"dropped-{number}").exists():
        number += 1
    aside = root / f"dropped-{number}"
    durable.make_folder(aside)
    durable.write_text(aside / FILE, "".join(entry.line + "\n" for entry in dropped))
    for name, trajectory in poses.items():
        lines = [trajectory.lines[trajectory.rows[i]] for i in _rows(dropped, trajectory)]
        durable.write_text(aside / pose_file(name), "".join(line + "\n" for line in lines))
    needed = {stored.path for entry in kept for stored in entry.files.values()}
    movable = [s.path for entry in dropped for s in entry.files.values() if s.path not in needed]
    for path in [*movable, extras.MARKERS]:  # markers were seen in frames that are gone
        if (root / path).is_file():
            durable.make_folder((aside / path).parent)
            os.replace(root / path, aside / path)
            durable.sync_folder((aside / path).parent)
            durable.sync_folder((root / path).parent)
    return aside


def _rewrite_poses(
    root: Path,
    name: str,
    trajectory: Trajectory,
    kept: Sequence[Entry],
    dropped: Sequence[Entry],
) -> list[str]:
    keep = set(_rows(kept, trajectory))
    gone = {line for i, line in enumerate(trajectory.rows) if i not in keep}
    lines = [line for i, line in enumerate(trajectory.lines) if i not in gone]
    _rewrite(root / pose_file(name), lines)
    orphans = len(gone) - len(_rows(dropped, trajectory))
    if orphans <= 0:
        return []
    return [f"{root / pose_file(name)}: dropped {orphans} poses without a frame"]


def _rows(entries: Sequence[Entry], trajectory: Trajectory) -> list[int]:
    rows = rows_of([entry.stamp for entry in entries], trajectory)
    return [int(i) for found in rows for i in found]


def _rewrite(path: Path, lines: Sequence[str]) -> None:
    """Replace a text file, unless it is just so already."""
    data = "".join(line + "\n" for line in lines).encode()
    if not path.exists() or path.read_bytes() != data:
        durable.write_bytes(path, data)


def _refuse_lost_listing(root: Path, kind: str) -> None:
    """Without the listing all frames would count as uncommitted, and new ones overwrite them."""
    if any((root / kind).glob("*.*")):
        raise DatasetError(
            f"{root / FILE}: no such file, though there are files in {kind}; expected the listing"
            " (an empty one, if none of them counts)"
        )


def _remove_parts(root: Path) -> None:
    for folder in (root, root / "depth", root / "rgb", root / "cloud"):
        for part in folder.glob(f".*{durable.PART}"):
            part.unlink()
