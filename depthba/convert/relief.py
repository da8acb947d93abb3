"""Whether the relief of the ground that two frames share fits better with other poses.

Over near-flat ground a depth that is too large by a factor puts plane on plane still, so that the
points agree as well as with the right one. What does not agree is the relief: every frame has it
in another place. So the heights of the one frame over the other are compared, less an offset and
a tilt, which are what measured poses leave.

The same is true of positions whose columns are in another order than they were read by.

Of units, only poses that should move more are looked for. Where they should move less, that is
where depth is too small, the overlap is destroyed; and a camera that stands still moves by nothing
but the noise of its poses, of which less is better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.convert import columns
from depthba.convert.frame_pairs import (
    FEWEST,
    Fixed,
    fixed_frames,
    neighbour,
    points,
)
from depthba.convert.recording import Convention, Recording

Array = NDArray[np.float64]

RATIO = 2.0
"""Heights that differ that many times as much are not explained by noise. Of 384 scenes in right
units the worst came to 1.13; depth 10 times too large comes to 1.6 over relief near the noise, to
2 to 35 over more."""
NOTHING = 1e-4
"""Of the range: smaller differences are none."""
POINTS = 1000
"""Of a frame that is laid on another."""
AT_LEAST = 3
"""Pairs that must be able to tell."""
MOVES = 10.0
"""A camera that moves farther than so many times its range shares no ground."""
SHARED = 0.2
"""Part of the points that must lie over the other frame."""
NEIGHBOURS = 12
"""Points that make up the ground under a point."""
INSIDE, FLAT, NEAR = 1.5, 0.1, 0.2
"""A point lies over ground when its neighbours lie around it: within so many of their spreads; when
they are a plane: of so much less variance across; and within that part of the range."""
ROUNDS = 3
"""Of weighted least squares."""


@dataclass(frozen=True)
class Better:
    """Units that explain the relief."""

    convention: Convention
    ratio: float
    """How many times as much heights differ under the declared one, median over pairs."""


def better(recording: Recording, factors: Sequence[float]) -> Better | None:
    """Return the units of poses, larger by one of the factors, that fit far better; or None."""
    declared = recording.convention
    fixed = list(fixed_frames(recording))
    found = []
    for factor in factors:
        if factor > 1.0:
            other = replace(declared, scale=declared.scale * factor)
            ratio = _ratio(recording, fixed, other.applied(recording.poses))
            if ratio >= RATIO:
                found.append(Better(other, ratio))
    return max(found, key=lambda one: one.ratio, default=None)


def columns_held(recording: Recording) -> tuple[str, float] | None:
    """Return what the columns of the positions hold where that fits far better; or None.

    And how many times as much heights differ as they are read, median over pairs.
    """
    fixed = list(fixed_frames(recording))
    found = {
        held: _ratio(recording, fixed, other.T_world_camera)
        for held, other in columns.reordered(recording)
    }
    best = max(found, key=lambda held: found[held])
    return (best, found[best]) if found[best] >= RATIO else None


def _ratio(recording: Recording, fixed: Sequence[Fixed], T_other: Array) -> float:
    """Return how many times as much heights differ as with other poses; 0 if none can tell.

    ``T_other``: (N, 4, 4), ``T_world_camera``.
    """
    T_declared = recording.T_world_camera
    ratios = []
    for at in fixed:
        j = neighbour(T_other, at.i, at.reach)
        T, T_moved = (se3.inverse(T[at.i]) @ T[j] for T in (T_declared, T_other))
        if np.linalg.norm(T_moved[:3, 3]) > MOVES * at.reach:
            continue
        moved = points(recording, j, POINTS)
        if len(moved) < FEWEST:
            continue
        declared = _difference(at, moved, T)
        if np.isfinite(declared):
            ratios.append((declared + NOTHING) / (_difference(at, moved, T_moved) + NOTHING))
    ratios = [ratio for ratio in ratios if np.isfinite(ratio)]
    return float(np.median(ratios)) if len(ratios) >= AT_LEAST else 0.0


def _difference(at: Fixed, moved: Array, T: Array) -> float:
    """Return how much heights differ less offset and tilt, median, of the range.

    NaN where hardly anything lies over the other frame.
    """
    p = moved @ T[:3, :3].T + T[:3, 3]
    ground = at.tree.data[at.tree.query(p, k=NEIGHBOURS)[1]]
    centre = ground.mean(axis=1)
    spread = ground - centre[:, None]
    variances, axes = np.linalg.eigh(np.einsum("nka,nkb->nab", spread, spread) / NEIGHBOURS)
    normal = axes[..., 0]
    normal *= np.where(np.sum(normal * centre, axis=1) < 0, 1.0, -1.0)[:, None]  # to the camera
    height = np.sum(normal * (p - centre), axis=1)
    aside = np.sqrt(np.maximum(np.sum((p - centre) ** 2, axis=1) - height**2, 0.0))
    over = aside < INSIDE * np.sqrt(np.maximum(variances[:, 2], 0.0))
    over &= variances[:, 0] < FLAT * variances[:, 1]
    over &= np.abs(height) < NEAR * at.reach
    if over.sum() < max(FEWEST, SHARED * len(over)):
        return float("nan")
    p, height = p[over] / at.reach, height[over] / at.reach
    up = normal[over].mean(axis=0)
    flat = np.linalg.svd(up[None])[2][1:]  # two directions across
    A = np.column_stack([np.ones(len(p)), p @ flat.T])
    weight = np.ones(len(p))
    for _ in range(ROUNDS):
        x = np.linalg.lstsq(A * weight[:, None], height * weight, rcond=None)[0]
        left = np.abs(height - A @ x)
        weight = 1.0 / np.hypot(1.0, left / (2.0 * np.median(left) + 1e-12))
    return float(np.median(left))
