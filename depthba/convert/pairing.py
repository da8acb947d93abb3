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
from depthba.words import count

Array = NDArray[np.float64]
Paired = list[tuple[int, float, Array]]
"""Index of a file, stamp in seconds, pose (4, 4)."""

_UNITS = (1.0, 1e-3, 1e-6, 1e-9)
"""Seconds per unit of stamps in names of files."""
_FACTORS = ((1e3, "ms"), (1e6, "µs"), (1e9, "ns"))
"""By which stamps are too large that are meant as seconds."""
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
            f"{names[-1]}){_missing(names, len(poses.poses))}, expected one each, or images whose "
            "names are the stamps of their poses"
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

    Raises:
        DatasetError: names are stamps, but of another clock or unit than those of the poses; or
            there are more files than poses or fewer, and names are no stamps.

    """
    names = [p.name for p in found]
    if poses.stamps is None:
        return by_order(names, poses), ()
    for unit in _UNITS:
        stamps = [_stamp(p, unit) for p in found]
        known = np.array([np.nan if s is None else s for s in stamps])
        if np.isnan(known).any() or len(set(known)) < len(known):
            break
        exact = np.isin(np.rint(known * 1e6), np.rint(poses.stamps * 1e6)).mean()
        if unit != 1.0 and any("." in _digits(p) for p in found):
            break  # with a point they are seconds
        # 000000.png to 000099.png lie within many a span
        telling = all(len(_digits(p)) >= _STAMP_DIGITS or "." in _digits(p) for p in found)
        among = _share_among(known, poses.stamps, max_gap) > 0.5
        if (telling and among) or (unit == 1.0 and exact == 1.0):
            paired, notes = by_stamp(names, known, poses, max_gap)
            # small stamps lie among those in ms, too, yet find no pose
            if 2 * len(paired) < len(found) and _other_unit(known, poses.stamps, max_gap):
                raise DatasetError(f"{poses.path}: {_misfit(found, poses.stamps, max_gap)}")
            return paired, notes + (_spare(known, poses.stamps) if exact > 0.5 else ())
    if _are_stamps([_digits(p) for p in found]) and not _are_counted(poses.stamps):
        raise DatasetError(f"{poses.path}: {_misfit(found, poses.stamps, max_gap)}")
    return by_order(names, poses), ("poses belong to the frames in their order",)


def _share_among(stamps: Array, of: Array, max_gap: float) -> float:
    """Return which part of stamps lies among others."""
    return float(((stamps >= of.min() - max_gap) & (stamps <= of.max() + max_gap)).mean())


def _spare(stamps: Array, of: Array) -> tuple[str, ...]:
    """Return a note on poses that no image belongs to, or none."""
    gone = of[~np.isin(np.rint(of * 1e6), np.rint(stamps * 1e6))]
    if not len(gone):
        return ()
    first = ", ".join(map(_plain, gone[:3])) + (", …" if len(gone) > 3 else "")
    return (f"{count(len(gone), 'pose')} without an image (stamp {first})",)


def _are_stamps(digits: Sequence[str]) -> bool:
    """Tell whether the numbers in names can only be stamps: not 0000000012, nor shot1.0012."""
    if len(set(digits)) < len(digits):
        return False
    if any("." not in d for d in digits):
        return all(len(d.partition(".")[0].lstrip("0")) >= _STAMP_DIGITS for d in digits)
    whole, parts = zip(*(d.split(".") for d in digits), strict=True)
    if len(set(whole)) > 1 or len(whole[0]) >= _STAMP_DIGITS or len(set(map(len, parts))) > 1:
        return True
    return bool((np.diff([float(part) for part in parts]) != 1).any())


def _are_counted(stamps: Array) -> bool:
    """Tell whether stamps are numbers of frames, 0 1 2 … or 1 2 3 …, which no clock gives."""
    return bool(stamps[0] in (0, 1) and (np.diff(stamps) == 1).all())


def _misfit(found: Sequence[Path], stamps: Array, max_gap: float) -> str:
    """Say how stamps that are names differ from those of poses, and what to do."""
    numbers = sorted((_digits(p) for p in found), key=float)
    named = np.array([float(d) for d in numbers])
    told = (
        f"stamps {_plain(stamps.min())} to {_plain(stamps.max())}, but images are named "
        f"{numbers[0]} to {numbers[-1]}"
    )
    if unit := _other_unit(named, stamps, max_gap):
        return f"{told}{unit}"
    units = (1.0,) if any("." in d for d in numbers) else _UNITS
    apart = min((float(stamps.min() - unit * named.min()) for unit in units), key=abs)
    return (
        f"{told}, {_plain(abs(apart))} s {'earlier' if apart > 0 else 'later'}: two clocks? "
        "Expected stamps of one clock: shift those of the poses, or number the images 000000, "
        "000001, … to join them in order"
    )


def _other_unit(named: Array, stamps: Array, max_gap: float) -> str:
    """Say by which factor stamps of poses, or those that are names, are no seconds; or ""."""
    for factor, unit in _FACTORS:
        if _cover(named * factor, stamps, factor * max_gap):
            return f": {factor:.0f} times as large ({unit}?), expected seconds"
        if _cover(named / factor, stamps, max_gap):
            return f", {factor:.0f} times as large ({unit}?), expected seconds with a point"
    return ""


def _cover(stamps: Array, of: Array, max_gap: float) -> bool:
    """Tell whether most stamps lie among others and span about as much."""
    spans = np.ptp(stamps), np.ptp(of)
    return bool(_share_among(stamps, of, max_gap) > 0.5 and 10 * min(spans) >= max(spans))


def _missing(names: Sequence[str], poses: int) -> str:
    """Return which files are missing between numbers that go up by one but for gaps; or ""."""
    digits = [_digits(Path(name)) for name in names]
    if not all(d.isdecimal() for d in digits):
        return ""
    there = {int(d) for d in digits}
    if len(there) < len(names) or not 0 < max(there) - min(there) + 1 - len(there) <= (
        poses - len(names)
    ):
        return ""
    gone = [k for k in range(min(there), max(there)) if k not in there]
    first = f"{gone[0]:0{min(map(len, digits))}d}"
    if len(gone) == 1:
        return f": {first} is missing"
    return f": {first} and {len(gone) - 1} more are missing"


def _plain(stamp: float) -> str:
    """Return a stamp to the µs, without zeros behind it."""
    return f"{stamp:.6f}".rstrip("0").rstrip(".")


def _digits(path: Path) -> str:
    """Return the last number in a name."""
    found = _NUMBER.findall(path.name[: -len(path.suffix)] if path.suffix else path.name)
    return str(found[-1]) if found else ""


def _stamp(path: Path, unit: float) -> float | None:
    """Return the last number in a name, s."""
    digits = _digits(path)
    return float(digits) * unit if digits else None
