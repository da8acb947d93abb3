"""Planes from adaptive voxels: cubes that split in eight until what they hold is flat.

The association is made once, at given poses, and frozen while they are
optimised.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from depthba.errors import OptionError
from eval.methods.balm2.clusters import (
    Floats,
    Ints,
    cluster_points,
    covariances,
    join_clusters,
    move_clusters,
)


@dataclass(frozen=True)
class VoxelOptions:
    """How planes are found."""

    size: float = 0.1
    """Edge of the root voxels, m."""
    flatness: tuple[float, ...] = (1 / 16, 1 / 16, 1 / 9)
    """Per layer, root first: the largest λ_min/λ_mid of a plane. As many layers as entries."""
    min_points: int = 15
    """A plane holds more points than this."""
    min_frames: int = 2
    """A plane is seen by as many frames at least."""

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        if not self.size > 0:
            raise OptionError(f"voxel size {self.size}: must be above 0")
        if not self.flatness:
            raise OptionError("flatness (): needs one entry per layer, one at least")


@dataclass(frozen=True, eq=False)
class Planes:
    """Plane features: which points, by frame, lie on one plane. Rows are clusters."""

    frames: int
    """Number of frames N."""
    clusters: Floats
    """(k, 4, 4), sensor frame, ordered by feature, then by frame."""
    frame: Ints
    """(k,) of each cluster."""
    feature: Ints
    """(k,) of each cluster, 0 to F - 1."""
    layer: Ints
    """(F,) of the voxel each was found in, 0 for a root."""

    def __len__(self) -> int:
        """Return the number of features F."""
        return len(self.layer)

    @property
    def first(self) -> Ints:
        """(F + 1,), where each feature's rows begin, and where the last one's end."""
        return np.searchsorted(self.feature, np.arange(len(self) + 1))

    @property
    def per_frame(self) -> Ints:
        """(N,), how many features each frame sees."""
        return np.bincount(self.frame, minlength=self.frames)

    def only(self, frames: NDArray[np.bool_]) -> Planes:
        """Return what some of the frames (N,) see of planes that two of them see or more."""
        keep = frames[self.frame]
        keep &= (np.bincount(self.feature[keep], minlength=len(self)) >= 2)[self.feature]
        _, first, feature = np.unique(self.feature[keep], return_index=True, return_inverse=True)
        layer = self.layer[self.feature[keep][first]]
        return Planes(self.frames, self.clusters[keep], self.frame[keep], feature, layer)

    @property
    def points(self) -> int:
        """How many points lie on planes."""
        return round(self.clusters[:, 3, 3].sum())


def find_planes(
    clouds: Sequence[NDArray[np.float32]], T_world_camera: Floats, options: VoxelOptions
) -> Planes:
    """Find the planes that frames see together.

    Args:
        clouds: per frame (n, 3), sensor frame, m.
        T_world_camera: (N, 4, 4), where the frames stand now.
        options: of the voxels.

    """
    layers = len(options.flatness)
    leaf, frame, clusters = _leaves(clouds, T_world_camera, options.size, layers)
    in_world = move_clusters(T_world_camera[frame], clusters)
    undecided = np.ones(len(leaf), dtype=bool)
    node_of_row = np.full(len(leaf), -1)
    layer_of_row = np.zeros(len(leaf), dtype=np.int64)
    for layer, flatness in enumerate(options.flatness):
        rows = np.flatnonzero(undecided)
        if not len(rows):
            break
        # a leaf's number begins with its ancestors'
        nodes, node = np.unique(leaf[rows] >> (3 * (layers - 1 - layer)), return_inverse=True)
        whole = join_clusters(in_world[rows], node, len(nodes))
        flat = _is_plane(whole, flatness, options.min_points)
        on_plane, dead = flat[node], (whole[:, 3, 3] <= options.min_points)[node]
        # numbers of different layers must not meet
        node_of_row[rows[on_plane]] = node[on_plane] + len(leaf) * layer
        layer_of_row[rows[on_plane]] = layer
        undecided[rows[on_plane | dead]] = False
    return _gather(len(clouds), clusters, frame, node_of_row, layer_of_row, options.min_frames)


def _leaves(
    clouds: Sequence[NDArray[np.float32]], T_world_camera: Floats, size: float, layers: int
) -> tuple[Ints, Ints, Floats]:
    """Return the clusters of all finest voxels and frames: voxel (k,), frame (k,), sums (k, 4, 4).

    Leaves are numbered so that a number shifted by three bits is that of the voxel around it.
    """
    points = np.concatenate([np.asarray(c, np.float32).reshape(-1, 3) for c in clouds])
    frame = np.repeat(np.arange(len(clouds)), [len(c) for c in clouds])
    if not len(points):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 4))
    root, octant = _locate(points, frame, np.ascontiguousarray(T_world_camera), size, layers)
    number = _numbered(root, room=2.0**62 / (8.0 ** (layers - 1) * len(clouds)))
    key = ((number << (3 * (layers - 1))) | octant) * len(clouds) + frame
    # neighbours in a cloud mostly share a leaf: only where the leaf changes is there what to sort
    begins = np.flatnonzero(np.diff(key, prepend=key[0] - 1))
    keys, slot = np.unique(key[begins], return_inverse=True)
    slot = np.repeat(slot, np.diff(begins, append=len(key)))
    leaf, leaf_frame = np.divmod(keys, len(clouds))
    return leaf, leaf_frame, cluster_points(points, slot, len(keys))


def _numbered(root: Ints, room: float) -> Ints:
    """Number voxels (3, n) by x, then y, then z, below ``room``."""
    root = root - root.min(axis=1, keepdims=True)
    if np.prod(root.max(axis=1) + 1.0) > room:
        # frames that flew off leave most coordinates empty
        root = np.stack([np.unique(axis, return_inverse=True)[1] for axis in root])
    extent = root.max(axis=1) + 1
    if np.prod(extent.astype(float)) > room:
        raise OptionError(f"voxels are too small: {' x '.join(map(str, extent))} are too many")
    return np.asarray((root[0] * extent[1] + root[1]) * extent[2] + root[2])


@nb.njit(cache=True, nogil=True)
def _locate(points, frame, T_world_camera, size, layers):
    """Return the root voxel (3, n) of each point and its octants (n,), three bits a layer.

    Roots and centres of voxels are told apart in single precision, as the authors' program does:
    points on a border then fall to the same side.
    """
    root = np.empty((3, points.shape[0]), np.int64)
    octant = np.zeros(points.shape[0], np.int64)
    for k in range(points.shape[0]):
        T = T_world_camera[frame[k]]
        for axis in range(3):
            q = T[axis, 3]
            for j in range(3):
                q += T[axis, j] * np.float64(points[k, j])
            cell = np.float32(q / size)
            if cell < 0:
                cell -= np.float32(1.0)
            index = np.int64(cell)
            root[axis, k] = index
            centre = np.float32((0.5 + index) * size)
            quarter = np.float32(size / 4.0)
            for layer in range(1, layers):
                upper = q > np.float64(centre)
                octant[k] |= np.int64(upper) << (3 * (layers - 1 - layer) + 2 - axis)
                centre = np.float32(centre + quarter if upper else centre - quarter)
                quarter = np.float32(quarter * np.float32(0.5))
    return root, octant


def _is_plane(C: Floats, flatness: float, min_points: int) -> NDArray[np.bool_]:
    """Tell which clusters (k, 4, 4) are flat, and of points enough."""
    enough = C[:, 3, 3] > min_points
    plane = np.zeros(len(C), dtype=bool)
    values = np.linalg.eigvalsh(covariances(C[enough])[1])
    plane[enough] = values[:, 0] < np.float32(flatness) * values[:, 1]
    return plane


def _gather(
    frames: int, clusters: Floats, frame: Ints, node: Ints, layer: Ints, min_frames: int
) -> Planes:
    """Join rows of one node and frame, and drop nodes of too few frames; node -1 is none."""
    rows = np.flatnonzero(node >= 0)
    keys, slot = np.unique(node[rows] * frames + frame[rows], return_inverse=True)
    joined = join_clusters(clusters[rows], slot, len(keys))
    nodes, row_frame = np.divmod(keys, frames)
    row_layer = np.zeros(len(keys), dtype=np.int64)
    row_layer[slot] = layer[rows]
    _, feature, seen_by = np.unique(nodes, return_inverse=True, return_counts=True)
    keep = seen_by[feature] >= min_frames
    _, first, feature = np.unique(feature[keep], return_index=True, return_inverse=True)
    return Planes(frames, joined[keep], row_frame[keep], feature, row_layer[keep][first])
