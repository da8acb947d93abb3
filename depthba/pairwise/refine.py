"""GICP of two frames that already lie close (small_gicp)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Neighbours from which the surface about a point is taken.
NEIGHBOURS = 15


def prepare(points: NDArray[np.float32], voxel: float) -> tuple[Any, Any]:
    """Thin a cloud (n, 3) to one point a voxel (m) and index it: what :func:`align` takes."""
    import small_gicp

    cloud, tree = small_gicp.preprocess_points(
        np.asarray(points, dtype=float), downsampling_resolution=voxel, num_neighbors=NEIGHBOURS
    )
    return cloud, tree


def align(
    target: tuple[Any, Any], source: tuple[Any, Any], T: Floats, reach: float
) -> tuple[Floats, int]:
    """Return T_target_source (4, 4) and the number of points that found one to lie on.

    Args:
        target: from :func:`prepare`.
        source: likewise.
        T: (4, 4), the start.
        reach: how far a point's counterpart may be, m.
    """
    import small_gicp

    found = small_gicp.align(
        target[0], source[0], target[1], T, registration_type="GICP",
        max_correspondence_distance=reach, max_iterations=15,
        translation_epsilon=reach / 50, rotation_epsilon=1e-3,
    )  # fmt: skip
    return np.asarray(found.T_target_source), int(found.num_inliers)
