"""Which pose belongs to which file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba.convert.pose_files import Poses
from depthba.convert.recording import left_out
from depthba.errors import DatasetError

Array = NDArray[np.float64]
Paired = list[tuple[int, float, Array]]
"""Index of a file, stamp in seconds, pose (4, 4)."""

_UNITS = (1.0, 1e-3, 1e-6, 1e-9)
"""Seconds per unit of stamps in names of files."""
_STAMP_DIGITS = 10
"""Seconds since 1970 have as many."""
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def by_stamp(
    names: Sequence[str], stamps: Sequence[float] | Array, poses: Poses, max_gap: float
) -> tuple[Paired, tuple[str, ...]]:
    """Give every file its pose by its stamp, and notes on those that have none.

    Raises:
        DatasetError: none has one.

    """
    assert poses.stamps is not None
    paired: Paired = []
    without = []
    for index, stamp in enumerate(stamps):
        pose = poses.at(float(stamp), max_gap)
        if pose is None:
            without.append(names[index])
        else:
            paired.append((index, float(stamp), pose))
    if not paired:
        raise DatasetError(
            f"{poses.path}: stamps {poses.stamps.min():.6f} to {poses.stamps.max():.6f} s, but the "
            f"{len(stamps)} frames are of {min(stamps):.6f} to {max(stamps):.6f} s: "
            "expected poses around the frames"
        )
    return paired, left_out(without, f"no pose within {max_gap:g} s on both sides")


def by_order(names: Sequence[str], poses: Poses) -> Paired:
    """Give every file the pose of its place; stamps are the poses' own, else the place.

    Raises:
        DatasetError: there are more of one than of the other.

    """
    if len(names) != len(poses.poses):
        raise DatasetError(
            f"{poses.path}: {len(poses.poses)} poses for {len(names)} frames ({names[0]} to "
            f"{names[-1]}), expected one each, or images whose names are the stamps of their poses"
        )
    stamps = np.arange(float(len(names))) if poses.stamps is None else poses.stamps
    values, counts = np.unique(stamps, return_counts=True)
    if (counts > 1).any():
        k = int(np.argmax(counts))
        raise DatasetError(
            f"{poses.path}: {counts[k]} poses of stamp {values[k]:.6f}, expected a stamp each"
        )
    return [(k, float(stamps[k]), poses.poses[k]) for k in range(len(names))]


def by_name(found: Sequence[Path], poses: Poses, max_gap: float) -> tuple[Paired, tuple[str, ...]]:
    """Give every file its pose: by the stamp that is its name, else by its place.

    A name is a stamp where it has a point or ten digits, and most, in s, ms, µs or ns, lie among
    the stamps of the poses; or where all are stamps of poses to the letter.
    """
    names = [p.name for p in found]
    if poses.stamps is None:
        return by_order(names, poses), ()
    for unit in _UNITS:
        stamps = [_stamp(p, unit) for p in found]
        known = np.array([np.nan if s is None else s for s in stamps])
        if np.isnan(known).any() or len(set(known)) < len(known):
            break
        span = poses.stamps.min() - max_gap, poses.stamps.max() + max_gap
        share = float(((known >= span[0]) & (known <= span[1])).mean())
        exact = np.isin(np.rint(known * 1e6), np.rint(poses.stamps * 1e6)).mean()
        if unit != 1.0 and any("." in _digits(p) for p in found):
            break  # with a point they are seconds
        # 000000.png to 000099.png lie within many a span
        telling = all(len(_digits(p)) >= _STAMP_DIGITS or "." in _digits(p) for p in found)
        if (telling and share > 0.5) or (unit == 1.0 and exact == 1.0):
            return by_stamp(names, known, poses, max_gap)
    return by_order(names, poses), ("poses belong to the frames in their order",)


def _digits(path: Path) -> str:
    """Return the last number in a name."""
    found = _NUMBER.findall(path.name[: -len(path.suffix)] if path.suffix else path.name)
    return str(found[-1]) if found else ""


def _stamp(path: Path, unit: float) -> float | None:
    """Return the last number in a name, s."""
    digits = _digits(path)
    return float(digits) * unit if digits else None
