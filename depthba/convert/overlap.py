"""Whether frames overlap under the convention of their poses; and if not, under which other.

A wrong convention is no fault that a file shows: it puts frames apart that saw the same ground. So
a few pairs of frames are laid on one another, and where the points of the one find hardly any of
the other, the other conventions are tried.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.convert import columns, frame_pairs, relief
from depthba.convert.frame_pairs import Pair
from depthba.convert.reading import Axes, Direction, Quaternions
from depthba.convert.recording import Convention, Recording
from depthba.errors import DatasetError

Array = NDArray[np.float64]

FACTORS = (1e-3, 1e-2, 0.1, 0.2, 5.0, 10.0, 100.0, 1e3)
"""Between the units of poses and of depth that people mix up."""
LEAST_SHIFT = 0.01
"""Of the range. Poses that hardly move at all lay any two frames on one another."""
GOOD, BETTER = 0.3, 0.2
"""Another convention explains the frames when that part of the points agrees, and it is that much
more, and at least twice as many."""
ENOUGH, NOTICEABLE = 0.7, 0.1
"""Below the one, other units are looked at; by the other more of the points is worth a word."""
LITTLE = 0.25
"""Frames of one scene agree in more."""
SURE = 0.5
"""That much is not by chance: poses of other frames, or wrong intrinsics, are not in question."""
SEEN = (0.05, 300.0)
"""How far away depth cameras see, m: of two units the one that leaves points there is named first.
"""
AS_GOOD = 0.8
"""With that part of the declared convention's share, another is as good."""


@dataclass(frozen=True)
class Verdict:
    """What was found."""

    share: float
    """Of points that agree under the convention, mean over the pairs; NaN where none could tell."""
    best: Convention
    """The one that explains the frames."""
    best_share: float
    as_good: tuple[Convention, ...] = ()
    """Others that the overlap cannot tell from the declared one."""
    reach: float = float("nan")
    """Typical distance of the points from their camera, m."""
    rescaled: tuple[Convention, float] | None = None
    """One of other units that explains more of the points, though not clearly, and its share."""
    held: str = columns.AS_READ
    """What the columns of the positions hold where that, and no convention, explains the frames:
    `best_share` is then by it."""


def check(recording: Recording) -> tuple[Verdict, tuple[str, ...]]:
    """Return what the overlap says, and notes.

    Raises:
        DatasetError: the frames overlap under another convention, not under this one; or the
            relief of the ground that they share fits with other units alone.

    """
    verdict = judge(recording)
    declared = recording.convention
    if np.isnan(verdict.share):
        return verdict, ("too few points or poses to see whether the conventions are right",)
    if verdict.best != declared:
        # a mixture of wrong things may explain poses of other frames by chance
        unsure = verdict.best_share < SURE
        doubt = "; or are the poses those of other frames, the intrinsics right?" if unsure else ""
        raise DatasetError(
            f"{recording.path}: frames agree in {verdict.share:.0%} of their points with "
            f"{declared}, but in {verdict.best_share:.0%} with {verdict.best}: "
            f"expected {_options(verdict.best, recording, verdict.reach)}, or --unchecked{doubt}"
        )
    expected = f"expected {' '.join(columns.AS_READ)}, or --unchecked"
    if verdict.held != columns.AS_READ:
        raise DatasetError(
            f"{recording.path}: frames agree in {verdict.share:.0%} of their points with "
            f"{declared}, but in {verdict.best_share:.0%} if the columns of the positions hold "
            f"{' '.join(verdict.held)}: {expected}"
        )
    finer = relief.better(recording, FACTORS)
    if finer is not None:
        raise DatasetError(
            f"{recording.path}: the ground that frames share differs {finer.ratio:.3g} times as "
            f"much as with poses {finer.convention.scale / declared.scale:g} times as large: "
            f"expected {_options(finer.convention, recording, verdict.reach)}, or --unchecked"
        )
    other = relief.columns_held(recording)
    if other is not None:
        held, ratio = other
        raise DatasetError(
            f"{recording.path}: the ground that frames share differs {ratio:.3g} times as "
            f"much as if the columns of the positions held {' '.join(held)}: {expected}"
        )
    notes: tuple[str, ...] = (
        f"frames agree in {verdict.share:.0%} of their points with {declared}",
    )
    if verdict.share < LITTLE:
        notes = (
            f"{notes[0]}, which is little, but no other convention does better: are the poses "
            "those of these frames, and the intrinsics right?",
        )
    if verdict.as_good:
        others = ", or ".join(map(str, verdict.as_good))
        notes = (f"{notes[0]}; the overlap cannot tell that from {others}",)
    if verdict.rescaled is not None:
        rescaled, found = verdict.rescaled
        options = _options(rescaled, recording, verdict.reach)
        notes += (f"with {options} they would agree in {found:.0%}: are the units right?",)
    span = float(np.linalg.norm(np.ptp(recording.T_world_camera[:, :3, 3], axis=0)))
    return verdict, (
        *notes,
        f"points lie about {_short(verdict.reach)} m from the cameras, "
        f"whose places span {_short(span)} m",
    )


def judge(recording: Recording) -> Verdict:
    """Lay pairs of frames on one another, under the convention and under others."""
    pairs = list(frame_pairs.pairs(recording))
    declared = recording.convention
    if not pairs:
        return Verdict(float("nan"), declared, float("nan"))
    share = _share(pairs, recording.poses, declared)
    least = max(GOOD, share + BETTER, 2 * share)
    others = {c: _share(pairs, recording.poses, c) for c in _others(declared, (1.0,))}
    as_good = tuple(c for c, found in others.items() if found >= AS_GOOD * share > 0.1)
    if share < 0.5 and max(others.values()) <= least:  # above, none could agree in twice as many
        others = {
            c: _share(pairs, recording.poses, c)
            for c in (*_others(declared, FACTORS), *_reordered(declared))
            if _moves(pairs, recording.poses, c)
        }
    best = max(others, key=lambda c: others[c], default=declared)
    reach = float(np.median([pair.reach for pair in pairs]))
    if best != declared and others[best] > least:
        return Verdict(share, best, _paired_anew(recording, best, others[best]), (), reach)
    if share < SURE:
        held, found = _by_columns(recording, pairs)
        if found > least:
            return Verdict(share, declared, found, (), reach, held=held)
    rescaled = _rescaled(pairs, recording, share) if share < ENOUGH else None
    if rescaled is not None and share < LITTLE and rescaled[1] >= max(SURE, least):
        return Verdict(share, *rescaled, (), reach)
    return Verdict(share, declared, share, as_good, reach, rescaled)


def _share(pairs: list[Pair], poses: Array, convention: Convention) -> float:
    """Return the part of the points that agree: the better of a frame's neighbours, their mean."""
    shares: dict[int, float] = {}
    for pair in pairs:
        T_i, T_j = convention.applied(poses[[pair.i, pair.j]])
        T = se3.inverse(T_i) @ T_j
        p = pair.moved @ T[:3, :3].T + T[:3, 3]
        found = pair.tree.query(p, distance_upper_bound=pair.tolerance)[0]
        shares[pair.i] = max(shares.get(pair.i, 0.0), float(np.isfinite(found).mean()))
    return float(np.mean(list(shares.values())))


def _paired_anew(recording: Recording, convention: Convention, share: float) -> float:
    """Return the share of a convention over pairs that are neighbours by it, if that is more.

    By wrong units pairs are chosen that in truth are far apart, or have hardly moved.
    """
    pairs = list(frame_pairs.pairs(replace(recording, convention=convention)))
    return max(share, _share(pairs, recording.poses, convention)) if pairs else share


def _rescaled(
    pairs: list[Pair], recording: Recording, share: float
) -> tuple[Convention, float] | None:
    """Return the convention of other units that does noticeably better, and its share."""
    declared, poses = recording.convention, recording.poses
    others = [replace(declared, scale=declared.scale * factor) for factor in FACTORS]
    found = {c: _share(pairs, poses, c) for c in others if _moves(pairs, poses, c)}
    best = max(found, key=lambda c: found[c], default=declared)
    if not found or found[best] <= share + NOTICEABLE:
        return None
    best_share = _paired_anew(recording, best, found[best])
    return (best, best_share) if best_share > GOOD else None  # little says nothing of units


def _by_columns(recording: Recording, pairs: list[Pair]) -> tuple[str, float]:
    """Return what the columns hold by which most of the points agree, and their share."""
    found = {}
    for held, other in columns.reordered(recording):
        # in the wrong order, frames were taken for neighbours that are far apart
        anew = list(frame_pairs.pairs(other))
        found[held] = max(
            _share(some, other.poses, other.convention) for some in (pairs, anew) if some
        )
    best = max(found, key=lambda held: found[held])
    return best, found[best]


def _moves(pairs: list[Pair], poses: Array, convention: Convention) -> bool:
    """Tell whether the camera moves noticeably, though not beyond what it sees."""
    shifts = []
    for pair in pairs:
        T_i, T_j = convention.applied(poses[[pair.i, pair.j]])
        shifts.append(float(np.linalg.norm(T_i[:3, 3] - T_j[:3, 3])) / pair.reach)
    return LEAST_SHIFT <= float(np.median(shifts)) <= 10.0


def _others(declared: Convention, factors: tuple[float, ...]) -> Iterator[Convention]:
    axes: tuple[Axes, ...] = ("opencv", "opengl")
    directions: tuple[Direction, ...] = ("camera-to-world", "world-to-camera")
    for one, way, factor in product(axes, directions, factors):
        other = replace(declared, axes=one, direction=way, scale=declared.scale * factor)
        if other != declared:
            yield other


def _reordered(declared: Convention) -> Iterator[Convention]:
    """Give conventions under which the file has its quaternions in the other order."""
    order: Quaternions = "wxyz" if declared.quaternions == "xyzw" else "xyzw"
    other = replace(declared, quaternions=order)
    yield from (other, *_others(other, (1.0,)))


def _options(best: Convention, recording: Recording, reach: float) -> str:
    """Return the options that lead to a convention; for other units, how far away points are then.

    Units of depth and of poses can both be what is wrong: the size of the scene tells which.
    """
    declared = recording.convention
    words = []
    if best.axes != declared.axes:
        words.append(f"--axes {best.axes}")
    if best.direction != declared.direction:
        words.append(f"--direction {best.direction}")
    if best.quaternions != declared.quaternions:
        words.append(f"--quaternions {best.quaternions}")
    if best.scale == declared.scale:
        return " ".join(words)
    factor = best.scale / declared.scale
    units = [(f"--pose-scale {best.scale:g}", reach)]
    if recording.depth_scale is not None:
        units.insert(0, (f"--depth-scale {recording.depth_scale / factor:g}", reach / factor))
        units.sort(key=lambda unit: not SEEN[0] <= unit[1] <= SEEN[1])
    told = ", or ".join(f"{option} (points {_short(away)} m away)" for option, away in units)
    return f"{' '.join(words)} with {told}" if words else told


def _short(value: float) -> str:
    """Return a number of three digits, without an exponent where it is not far from 1."""
    return f"{float(f'{value:.3g}'):g}"
