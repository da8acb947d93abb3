"""Normals, FPFH descriptors and their mutual matches, for registrations that go by features.

Rusu, Blodow and Beetz, "Fast Point Feature Histograms (FPFH) for 3D Registration", 2009. The
pairwise start itself correlates height maps, which also works where a surface has no features.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from depthba.compiling import kernel

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

BINS = 11
LENGTH = 3 * BINS


def thinned(points: NDArray[np.float32], voxel: float) -> Floats:
    """Return the mean point (m, 3) of each voxel (m) of a cloud (n, 3), in the voxels' order."""
    cells = np.floor(points.astype(float) / voxel).astype(np.int64)
    _, which, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    sums = [np.bincount(which, points[:, k].astype(float)) for k in range(3)]
    return np.asarray(np.stack(sums, axis=1) / counts[:, None])


def normals(points: Floats, radius: float, most: int = 30) -> Floats:
    """Return unit normals (n, 3) towards the origin, where the sensor stands.

    Args:
        points: (n, 3), sensor frame, m.
        radius: of the neighbourhood that a plane is fitted to, m.
        most: neighbours of it that are used, the nearest.
    """
    index, _ = _neighbours(points, radius, most, itself=True)
    near = index >= 0
    weight = near[..., None] / np.maximum(near.sum(axis=1), 1)[:, None, None]
    about = points[np.maximum(index, 0)] - points[:, None]
    about = about - (weight * about).sum(axis=1, keepdims=True)
    covariance = np.einsum("nki,nkj->nij", weight * about, about)
    found = np.linalg.eigh(covariance)[1][..., 0]
    away = np.einsum("ni,ni->n", found, points) > 0
    return np.asarray(np.where(away[:, None], -found, found))


def fpfh(points: Floats, normal: Floats, radius: float, most: int = 100) -> NDArray[np.float32]:
    """Return the descriptors (n, 33): three angles in 11 bins each, in per cent of each angle.

    Args:
        points: (n, 3), m.
        normal: (n, 3), unit length.
        radius: of the neighbourhood that is described, m.
        most: neighbours of it that are used, the nearest.
    """
    index, distance = _neighbours(points, radius, most, itself=False)
    simple = _simple(points, normal, index)
    out = _blended(simple, index, distance).reshape(-1, 3, BINS)
    total = out.sum(axis=2, keepdims=True)
    scaled = np.where(total > 0, 100 * out / np.maximum(total, 1e-12), 0.0)
    return np.asarray(scaled.reshape(-1, LENGTH), np.float32)


def mutual(a: NDArray[np.float32], b: NDArray[np.float32]) -> Indices:
    """Return the pairs (m, 2) of descriptors that are each other's nearest."""
    to_b = cKDTree(b).query(a)[1]
    to_a = cKDTree(a).query(b)[1]
    here = np.arange(len(a))
    agree = to_a[to_b] == here
    return np.asarray(np.stack([here[agree], to_b[agree]], axis=1), np.int64)


def _neighbours(
    points: Floats, radius: float, most: int, itself: bool
) -> tuple[NDArray[np.int64], Floats]:
    """Return indices (n, k) of the nearest within the radius, -1 beyond, and their distances."""
    most = min(most + 1, len(points))
    distance, index = cKDTree(points).query(points, k=most, distance_upper_bound=radius)
    distance, index = distance.reshape(len(points), -1), index.reshape(len(points), -1)
    wrong = ~np.isfinite(distance)
    if not itself:
        wrong |= index == np.arange(len(points))[:, None]
    return np.where(wrong, -1, index).astype(np.int64), np.where(wrong, 0.0, distance)


@kernel
def _simple(points, normal, index):
    """Histogram each point's angles with its neighbours: alpha, phi, theta (eq. 1 there)."""
    out = np.zeros((len(points), LENGTH))
    for p in range(len(points)):
        count = 0
        for q in index[p]:
            if q < 0:
                continue
            line = points[q] - points[p]
            length = np.sqrt((line * line).sum())
            if length < 1e-12:
                continue
            line = line / length
            # the source is the point whose normal leaves the smaller angle with the line
            u, other = normal[p], normal[q]
            if abs((normal[p] * line).sum()) < abs((normal[q] * line).sum()):
                u, other, line = normal[q], normal[p], -line
            phi = (u * line).sum()
            v = np.cross(line, u)
            size = np.sqrt((v * v).sum())
            if size < 1e-9:
                continue
            v = v / size
            w = np.cross(u, v)
            alpha = (v * other).sum()
            theta = np.arctan2((w * other).sum(), (u * other).sum())
            shares = ((alpha + 1) / 2, (phi + 1) / 2, (theta + np.pi) / (2 * np.pi))
            for k in range(3):
                out[p, k * BINS + min(max(int(shares[k] * BINS), 0), BINS - 1)] += 1.0
            count += 1
        if count:
            out[p] /= count
    return out


@kernel
def _blended(simple, index, distance):
    """Add the neighbours' histograms, weighted by the inverse of their distance (eq. 2 there)."""
    out = np.zeros_like(simple)
    for p in range(len(simple)):
        count, total = 0, 0.0
        for k in range(index.shape[1]):
            q = index[p, k]
            if q >= 0 and distance[p, k] > 0:
                count += 1
                total += 1.0 / distance[p, k]
        for k in range(index.shape[1]):
            q = index[p, k]
            if q >= 0 and distance[p, k] > 0:
                out[p] += simple[q] / (distance[p, k] * total)
        out[p] += simple[p]
    return out
