"""The points of all frames with their colours: loaded, moved, cropped and thinned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba.dataset import Dataset

Floats = NDArray[np.float64]
Colours = NDArray[np.uint8]


@dataclass(frozen=True)
class FrameCloud:
    """The points of one frame."""

    points: Floats
    """(n, 3), metres, sensor frame."""
    colours: Colours | None
    """(n, 3), red green blue; None where the frame has no colour image."""


def load_clouds(dataset: Dataset, *, colours: bool = True) -> tuple[FrameCloud, ...]:
    """Read the points of all frames.

    Args:
        dataset: whose frames to read.
        colours: whether to read the colour images too.

    Raises:
        DatasetError: a file is missing or not as committed.

    """
    clouds = []
    for frame in dataset:
        camera = dataset.sensor.camera
        if camera is None:
            clouds.append(FrameCloud(np.asarray(frame.points(), dtype=float), None))
            continue
        depth = frame.depth().astype(float)
        if step := dataset.sensor.depth_scale:
            depth = np.rint(depth / step) * step  # the digits that single precision cut
        measured = np.isfinite(depth) & (depth > 0)
        points = camera.rays()[measured] * depth[measured][:, None]
        rgb = frame.rgb() if colours else None
        clouds.append(FrameCloud(points, None if rgb is None else rgb[measured]))
    return tuple(clouds)


def point_spacing(dataset: Dataset, points: Sequence[NDArray[np.floating]]) -> float:
    """Return the typical distance of neighbouring points, metres.

    Depth images: median over frames of the median depth over the focal length. Clouds: median
    distance to the nearest neighbour in the sensor's x-y plane, from up to 2000 points a frame.

    Args:
        dataset: whose sensor took the points.
        points: per frame (n_i, 3), sensor frame, metres.

    """
    points = [p for p in points if len(p)]
    if not points:
        return float("nan")
    camera = dataset.sensor.camera
    if camera is not None:
        return float(np.median([np.median(p[:, 2]) for p in points]) / camera.fx)
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    nearest = []
    for p in points:
        few = p[rng.choice(len(p), min(2000, len(p)), replace=False), :2]
        nearest.append(np.median(cKDTree(p[:, :2]).query(few, k=2)[0][:, 1]))
    return float(np.median(nearest))


def transform(T: Floats, points: NDArray[np.floating]) -> Floats:
    """Return ``T`` (4, 4) applied to ``points`` (n, 3)."""
    x, y, z = points.T
    # column by column: for three columns a matrix product costs more in threads than it saves
    return np.stack([(r[0] * x + r[1] * y) + (r[2] * z + r[3]) for r in T[:3]], axis=1)


def inside(points: NDArray[np.floating], roi: Sequence[float] | None) -> NDArray[np.bool_]:
    """Return which ``points`` (n, 3) lie in ``roi``, xmin xmax ymin ymax zmin zmax; None: all."""
    if roi is None:
        return np.ones(len(points), dtype=bool)
    keep = np.ones(len(points), dtype=bool)
    for axis, low, high in zip(points.T, roi[0::2], roi[1::2], strict=True):
        keep &= (axis >= low) & (axis <= high)
    return keep


def thin(rows: Floats, voxel: float) -> Floats:
    """Average rows per cube of a grid.

    Args:
        rows: (n, c), metres in the first three columns, anything (such as a colour) in the others.
        voxel: edge of the cubes, metres.

    Returns:
        (m, c), ordered by cube: x, then y, then z.

    """
    if not len(rows):
        return rows
    points = rows[:, :3]
    k = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64)
    number = np.ravel_multi_index(tuple(k.T), tuple(k.max(axis=0) + 1))
    _, cube, count = np.unique(number, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(cube, column) / count for column in rows.T], axis=1)
