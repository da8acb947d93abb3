"""Keypoints with FPFH descriptors, and the matches between two frames.

FPFH: Rusu, Blodow, Beetz, "Fast Point Feature Histograms (FPFH) for 3D Registration", ICRA 2009,
as Open3D computes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from depthba.clouds import thin
from eval.methods.method import MethodError, Task

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NORMAL_RADIUS, NORMAL_NEIGHBOURS = 2.5, 40
"""Of the points that a normal is fitted to: radius in voxels, and how many at most."""
FEATURE_RADIUS, FEATURE_NEIGHBOURS = 6.0, 150
"""Of the points that a descriptor tells about."""
LENGTH = 33
"""Of a descriptor."""

SPACINGS = 4.0
"""Least voxel, in typical distances of neighbouring points: 16 points to one of a flat surface."""
MOST_KEYPOINTS = 10_000
"""Per frame, by which a voxel is chosen: about as many as the reference figures were made with."""
REACH = 2.0
"""In a frame's median ranges: how far points are described."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """The thinned points of one frame, and what the surface around each looks like."""

    points: Floats
    """(n, 3), sensor frame, m."""
    descriptors: Floats
    """(n, 33), FPFH."""


def near(points: Floats, reach: float = REACH) -> Floats:
    """Return the points (n, 3) of a frame that are no background; the sensor is at the origin.

    A room behind the scene fills more voxels than the scene itself, sparsely and with plain walls:
    its keypoints match everywhere, and few are left for the scene.

    Args:
        points: (m, 3), sensor frame, m.
        reach: largest range kept, in median ranges; infinity keeps all.

    """
    if not len(points) or not np.isfinite(reach):
        return points
    ranges = np.linalg.norm(points, axis=1)
    return points[ranges <= reach * np.median(ranges)]


def near_clouds(task: Task, reach: float = REACH) -> tuple[Floats, ...]:
    """Return the points of each frame that are no background: all where rays have no one origin."""
    if not task.dataset.sensor.origin:
        return task.clouds
    return tuple(near(cloud, reach) for cloud in task.clouds)


def usual_voxel(clouds: Sequence[Floats], spacing: float) -> float:
    """Return the voxel, m, that frames are thinned to where none is asked for.

    Four spacings, so that a keypoint averages about 16 points and its noise is a quarter of
    theirs. Frames of many pixels would then have so many keypoints that the time goes into
    descriptors of ever smaller pieces of surface: the voxel grows until the median of three frames,
    the first, middle and last, has at most `MOST_KEYPOINTS`. What it settles on, in spacings: 4 on
    images of 320 x 240, about 12 on the laboratory scenes and 13 on the industrial ones.

    Args:
        clouds: per frame (n, 3), m, without background.
        spacing: typical distance of neighbouring points, m.

    """
    if not spacing > 0:
        raise MethodError(f"no voxel can be chosen for a point spacing of {spacing} m")
    voxel = SPACINGS * spacing
    some = [clouds[i] for i in sorted({0, len(clouds) // 2, len(clouds) - 1})]
    while (count := float(np.median([len(thin(p, voxel)) for p in some]))) > MOST_KEYPOINTS:
        # A surface fills voxels by the square; 2% more, so that this ends.
        voxel *= 1.02 * (count / MOST_KEYPOINTS) ** 0.5
    return voxel


def describe(points: Floats, voxel: float) -> Keypoints:
    """Return the keypoints of one frame.

    Args:
        points: (n, 3), sensor frame, the sensor at the origin, m.
        voxel: edge of the cubes that they are averaged in, m.

    """
    import open3d as o3d  # takes seconds

    if not len(points):
        return Keypoints(np.empty((0, 3)), np.empty((0, LENGTH)))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
    around = o3d.geometry.KDTreeSearchParamHybrid
    cloud.estimate_normals(around(NORMAL_RADIUS * voxel, NORMAL_NEIGHBOURS))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    fpfh = o3d.pipelines.registration.compute_fpfh_feature(  # type: ignore[call-arg]
        cloud, around(FEATURE_RADIUS * voxel, FEATURE_NEIGHBOURS)
    )
    return Keypoints(np.array(cloud.points), np.ascontiguousarray(fpfh.data.T))


def match(target: Keypoints, source: Keypoints, most: int, threads: int = 1) -> Ints:
    """Return the keypoints of two frames that are each other's nearest by descriptor.

    Args:
        target: of one frame.
        source: of the other.
        most: how many to keep: those whose nearest target is nearest by far, by the ratio of its
            distance to that of the second nearest.
        threads: for the search.

    Returns:
        (m, 2) int64, rows of target and source, best first.

    """
    if len(target.points) < 2 or not len(source.points):
        return np.empty((0, 2), np.int64)
    distance, nearest = cKDTree(target.descriptors).query(source.descriptors, 2, workers=threads)
    _, back = cKDTree(source.descriptors).query(target.descriptors, 1, workers=threads)
    rows = np.flatnonzero(back[nearest[:, 0]] == np.arange(len(source.points)))
    first, second = distance[rows].T
    # Two targets that both fit exactly tell nothing: 0/0 counts as 1.
    ratio = np.divide(first, second, out=np.ones_like(first), where=second > 0)
    rows = rows[np.argsort(ratio, kind="stable")[:most]]
    return np.column_stack([nearest[rows, 0], rows]).astype(np.int64)
