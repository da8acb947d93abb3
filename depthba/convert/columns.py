"""Positions whose columns a file has in another order than they were read by."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations

from depthba.convert.recording import Recording

AS_READ = "xyz"
"""The columns of positions, as they are read."""


def reordered(recording: Recording) -> Iterator[tuple[str, Recording]]:
    """Give what the columns may hold in place of x, y, z, and the recording read that way."""
    poses = recording.poses
    for held in map("".join, permutations(AS_READ)):
        if held == AS_READ:
            continue
        T = poses.copy()
        T[:, :3, 3] = poses[:, [held.index(axis) for axis in AS_READ], 3]
        frames = tuple(replace(f, pose=M) for f, M in zip(recording.frames, T, strict=True))
        yield held, replace(recording, frames=frames)
