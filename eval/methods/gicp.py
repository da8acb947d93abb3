"""Pairwise registration by generalised ICP: small_gicp behind typed functions.

Segal, Haehnel and Thrun, Generalized-ICP (RSS 2009), as Koide's small_gicp has it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""Turns [rotation, translation], as small_gicp and gtsam have it, into [translation, rotation], as
`depthba.se3` has it, and back."""


@dataclass(frozen=True)
class GicpOptions:
    """How pairs are registered."""

    neighbours: int = 20
    """Points that a covariance is fitted to."""
    iterations: int = 50
    """At most so many."""
    rotation_epsilon: float = 1e-4
    """A smaller step counts as converged, rad. The package's own 1.7 mrad stops too early for
    frames a metre wide; a tenth of this makes pairs creep for little."""
    translation_epsilon: float = 1e-4
    """The same, m; the package's own is 1 mm."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A frame's cloud, thinned, with a covariance at each point and a search tree."""

    cloud: Any
    """small_gicp.PointCloud."""
    tree: Any
    """small_gicp.KdTree of it."""

    def __len__(self) -> int:
        """Return the number of points left."""
        return int(self.cloud.size())


@dataclass(frozen=True, eq=False)
class Alignment:
    """How a source frame lies on a target frame."""

    T_target_source: Floats
    """(4, 4)."""
    H: Floats
    """(6, 6), second derivative of the cost by delta = [tau, phi] in T_target_source Exp(delta):
    translation first, axes of the source frame. Its scale is not that of 1 / m^2: the covariances
    of generalised ICP have unit length along the surface."""
    inliers: int
    """Points of the source with a partner."""
    converged: bool
    iterations: int


def prepare(points: Floats, voxel: float, options: GicpOptions, threads: int = 1) -> Prepared:
    """Thin a cloud (n, 3), m, to a point per cube of edge ``voxel`` and fit covariances."""
    import small_gicp

    cloud, tree = small_gicp.preprocess_points(
        np.ascontiguousarray(points, dtype=np.float64),
        downsampling_resolution=voxel,
        num_neighbors=options.neighbours,
        num_threads=threads,
    )
    return Prepared(cloud, tree)


def align(
    target: Prepared,
    source: Prepared,
    T_target_source: Floats,
    reach: float,
    options: GicpOptions,
    threads: int = 1,
) -> Alignment:
    """Register a source frame to a target frame.

    Args:
        target: the frame that stays.
        source: the frame that moves.
        T_target_source: (4, 4), where to start.
        reach: partners are closer than this, m.
        options: when to stop.
        threads: of the kernels.

    """
    import small_gicp

    if not len(target) or not len(source):
        return Alignment(T_target_source.copy(), np.zeros((6, 6)), 0, False, 0)
    found = small_gicp.align(
        target.cloud,
        source.cloud,
        target.tree,
        np.ascontiguousarray(T_target_source, dtype=np.float64),
        registration_type="GICP",
        max_correspondence_distance=reach,
        num_threads=threads,
        max_iterations=options.iterations,
        rotation_epsilon=options.rotation_epsilon,
        translation_epsilon=options.translation_epsilon,
    )
    H = np.asarray(found.H, dtype=np.float64)[np.ix_(ROTATION_FIRST, ROTATION_FIRST)]
    return Alignment(
        T_target_source=np.asarray(found.T_target_source, dtype=np.float64),
        H=0.5 * (H + H.T),
        inliers=int(found.num_inliers),
        converged=bool(found.converged),
        iterations=int(found.iterations),
    )
