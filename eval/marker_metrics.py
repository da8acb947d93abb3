"""Distances between markers on the ground: what a user of a long gantry measures in the end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from depthba.clouds import transform
from depthba.dataset.model import Marker
from eval.metrics import Metric

Floats = NDArray[np.float64]

ORIGIN = "origin"
"""Name of the marker that distances are taken from."""
FAR = {"x": "far_x", "y": "far_y"}
"""Names of the markers at the far ends of the axes."""


def marker_metrics(
    markers: Sequence[Marker], frame_ids: Sequence[int], T_world_camera: Floats
) -> list[Metric]:
    """Judge poses by the distances of markers.

    What the frames saw of a marker is carried into the world by their poses and averaged to m^.
    The error along an axis is ``| |m^_far - m^_origin| - |m_far - m_origin| |``, which does not
    depend on the world's frame.

    Args:
        markers: true positions and observations.
        frame_ids: (N,), of the frames that the poses are of; others' observations do not count.
        T_world_camera: (N, 4, 4).

    Returns:
        One metric per axis, NaN where no frame saw a marker; none where the dataset lacks them.

    """
    named = {m.name: m for m in markers}
    row = {frame: k for k, frame in enumerate(frame_ids)}
    found = []
    for axis, name in FAR.items():
        if ORIGIN not in named or name not in named:
            continue
        far, origin = named[name], named[ORIGIN]
        estimated = _mean(far, row, T_world_camera) - _mean(origin, row, T_world_camera)
        true = far.p_world - origin.p_world
        error = abs(float(np.linalg.norm(estimated)) - float(np.linalg.norm(true)))
        found.append(Metric(f"marker_error_{axis}", "m", "lower", error))
    return found


def _mean(marker: Marker, row: dict[int, int], T_world_camera: Floats) -> Floats:
    """Return the mean observed position (3,) in the world, NaN where no frame saw it, m."""
    seen = [
        transform(T_world_camera[row[frame]], p_camera[None])[0]
        for frame, p_camera in marker.observations
        if frame in row
    ]
    return np.mean(seen, axis=0) if seen else np.full(3, np.nan)
