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

    return small_gicp.preprocess_points(
        np.asarray(points, dtype=float), downsampling_resolution=voxel, num_neighbors=NEIGHBOURS
    )  # type: ignore[no-any-return]


def align(
    target: tuple[Any, Any], source: tuple[Any, Any], T: Floats, reaches: tuple[float, ...]
) -> tuple[Floats, int]:
    """Return T_target_source (4, 4) and the number of points that found one to lie on.

    Args:
        target: from :func:`prepare`.
        source: likewise.
        T: (4, 4), the start.
        reaches: how far a point's counterpart may be, m, one run after the other.
    """
    import small_gicp

    inliers = 0
    for reach in reaches:
        found = small_gicp.align(
            target[0], source[0], target[1], T, registration_type="GICP",
            max_correspondence_distance=reach, max_iterations=40,
            translation_epsilon=reach / 1000, rotation_epsilon=1e-4,
        )  # fmt: skip
        T, inliers = np.asarray(found.T_target_source), int(found.num_inliers)
    return T, inliers
