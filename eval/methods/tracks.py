"""Tracks: keypoints of several frames that matches say are one point of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of landmarks, ordered by track, then by frame; one a frame and track."""

    frames: int
    """Number of frames N."""
    track: Ints
    """(k,) landmark of each observation, 0 to L - 1."""
    frame: Ints
    """(k,) that made it."""
    points: Floats
    """(k, 3), sensor frame, m."""
    dropped: int = 0
    """Tracks that contradict themselves: they hold two points of one frame."""

    def __len__(self) -> int:
        """Return the number of landmarks L."""
        return int(self.track[-1]) + 1 if len(self.track) else 0


@dataclass(frozen=True, eq=False)
class Link:
    """Matches between two frames."""

    a: int
    b: int
    matches: Ints
    """(m, 2), rows of the points of frames a and b."""


def tied_frames(tracks: Tracks, fewest: int = 3) -> NDArray[np.bool_]:
    """Return (N,), which frames landmarks tie to frame 0.

    A frame is tied where it sees as many landmarks as ``fewest`` that tied frames see; three fix a
    pose.
    """
    tied = np.zeros(tracks.frames, dtype=bool)
    tied[0] = True
    while True:
        placed = np.bincount(tracks.track, tied[tracks.frame], minlength=len(tracks)) > 0
        seen = np.bincount(tracks.frame, placed[tracks.track], minlength=tracks.frames)
        grown = tied | (seen >= fewest)
        if np.array_equal(grown, tied):
            return tied
        tied = grown


def only_frames(tracks: Tracks, frames: NDArray[np.bool_]) -> Tracks:
    """Return what some of the frames (N,) observe, of landmarks that two of them see or more."""
    keep = frames[tracks.frame]
    seen = np.bincount(tracks.track[keep], minlength=len(tracks))
    keep &= seen[tracks.track] >= 2
    _, track = np.unique(tracks.track[keep], return_inverse=True)
    return Tracks(tracks.frames, track, tracks.frame[keep], tracks.points[keep], tracks.dropped)


def build_tracks(points: Sequence[Floats], links: Sequence[Link]) -> Tracks:
    """Join matches to tracks.

    What hangs together through matches is one track. One that holds two points of a frame has a
    wrong match somewhere: it is dropped whole.

    Args:
        points: per frame (n, 3), sensor frame, m.
        links: between the frames.

    """
    first = np.concatenate([[0], np.cumsum([len(p) for p in points])])
    for link in links:
        for k, rows in ((link.a, link.matches[:, 0]), (link.b, link.matches[:, 1])):
            if len(rows) and (rows.min() < 0 or rows.max() >= len(points[k])):
                raise ValueError(
                    f"match of frames {link.a} and {link.b}: row {rows.max()} of frame {k}, which "
                    f"has {len(points[k])} points"
                )
    empty = np.zeros(0, dtype=np.int64)
    a = np.concatenate([empty, *(first[k.a] + k.matches[:, 0] for k in links)])
    b = np.concatenate([empty, *(first[k.b] + k.matches[:, 1] for k in links)])
    total = int(first[-1])
    graph = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(total, total))
    _, group = connected_components(graph, directed=False)

    node = np.unique(np.concatenate([a, b]))  # the points that are matched at all
    frame = np.searchsorted(first, node, side="right") - 1
    order = np.lexsort((frame, group[node]))
    node, frame = node[order], frame[order]
    _, track = np.unique(group[node], return_inverse=True)
    twice = (np.diff(track) == 0) & (np.diff(frame) == 0)
    torn = np.unique(track[1:][twice])
    keep = ~np.isin(track, torn)
    _, track = np.unique(track[keep], return_inverse=True)
    everything = np.concatenate([np.zeros((0, 3)), *points])
    return Tracks(len(points), track, frame[keep], everything[node[keep]], len(torn))
