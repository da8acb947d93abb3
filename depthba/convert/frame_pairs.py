"""Pairs of frames between which the camera has moved, to be laid on one another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.convert.recording import Recording
from depthba.errors import DatasetError

Array = NDArray[np.float64]

PAIRS = 6
"""Frames for which a neighbour is looked for."""
FIXED_POINTS, MOVED_POINTS = 20_000, 1500
"""Points of the one frame, and of the other, at most."""
FEWEST = 100
"""A frame of fewer points says nothing."""
TURN, SHIFT = 0.2, 0.25
"""A pair has moved enough when it has turned by that, rad, or shifted by that part of the range."""
TOLERANCE = 0.02
"""Of the range: points that near are the same."""


@dataclass(frozen=True, eq=False)
class Fixed:
    """A frame on which others are laid."""

    i: int
    tree: Any
    """Of its points, m."""
    reach: float
    """Typical distance of its points, m."""


@dataclass(frozen=True, eq=False)
class Pair:
    """A frame laid on another."""

    i: int
    j: int
    tree: Any
    """Of the points of frame i."""
    moved: Array
    """(n, 3), points of frame j, m."""
    tolerance: float
    """m."""
    reach: float
    """Typical distance of the points of frame i, m."""


def fixed_frames(recording: Recording) -> Iterator[Fixed]:
    """Give frames that are spread over the recording and have points."""
    from scipy.spatial import cKDTree

    count = len(recording.frames)
    if count < 2:
        return
    for i in sorted({round(k) for k in np.linspace(0, count - 1, PAIRS)}):
        fixed = points(recording, i, FIXED_POINTS)
        if len(fixed) >= FEWEST:
            yield Fixed(i, cKDTree(fixed), float(np.median(np.linalg.norm(fixed, axis=1))))


def pairs(recording: Recording) -> Iterator[Pair]:
    """Give pairs of frames, spread over the recording, between which the camera has moved."""
    poses = recording.T_world_camera
    for at in fixed_frames(recording):
        some = at.tree.data[:: max(1, len(at.tree.data) // 500)]
        spacing = float(np.median(at.tree.query(some, k=2)[0][:, 1]))
        tolerance = max(2 * spacing, TOLERANCE * at.reach)
        # which are neighbours depends on which way the poses map: those of either way are tried
        for j in sorted({neighbour(T, at.i, at.reach) for T in (poses, se3.inverse(poses))}):
            moved = points(recording, j, MOVED_POINTS)
            if len(moved) >= FEWEST:
                yield Pair(at.i, j, at.tree, moved, tolerance, at.reach)


def neighbour(poses: Array, i: int, reach: float) -> int:
    """Return the nearest of the frames that have moved enough: it sees most of the same ground."""
    between = se3.inverse(poses[i]) @ poses
    turned = np.linalg.norm(se3.log_so3(between[:, :3, :3]), axis=1) / TURN
    shifted = np.linalg.norm(between[:, :3, 3], axis=1) / (SHIFT * reach)
    moved = np.maximum(turned, shifted)
    enough = np.nonzero(moved >= 1)[0]
    return int(enough[np.argmin(moved[enough])] if len(enough) else np.argmax(moved))


def points(recording: Recording, k: int, most: int) -> Array:
    """Return at most so many points (n, 3) of a frame, m."""
    frame = recording.frames[k]
    if frame.depth is None:
        assert frame.cloud is not None
        cloud = frame.cloud()
        return np.asarray(cloud[:: max(1, len(cloud) // most)])
    assert frame.camera is not None
    z, rays = frame.depth(), frame.camera.rays()
    if z.shape != rays.shape[:2]:
        raise DatasetError(
            f"{recording.path}: {frame.name}: {z.shape[1]} x {z.shape[0]} pixels, "
            f"expected {frame.camera.width} x {frame.camera.height}"
        )
    step = max(1, int(np.sqrt(z.size / most)))
    z, rays = z[step // 2 :: step, step // 2 :: step], rays[step // 2 :: step, step // 2 :: step]
    seen = np.isfinite(z) & (z > 0) & np.isfinite(rays[..., 0])
    return np.asarray(rays[seen] * z[seen][:, None])
