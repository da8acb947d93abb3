"""Cuts: what of a frame counts. They act when a frame is loaded; the files stay as they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera

Array = NDArray[np.float64]
Bounds = tuple[float, float]
Roi = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class Cut:
    """What of one frame counts; None: all."""

    depths: Bounds | None = None
    """Least and greatest z in the sensor frame, m."""
    roi: Roi | None = None
    """xmin xmax ymin ymax zmin zmax in the map frame, m; may be infinite."""
    T_map_camera: Array | None = None
    """(4, 4), goes with ``roi``."""
    mask: NDArray[np.bool_] | None = None
    """(height, width), True where the image counts."""

    def points(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return those of the points (n, 3), sensor frame, m, that count; a mask has no say."""
        return np.ascontiguousarray(points[self._inside(points)])

    def depth(self, depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
        """Return depth (height, width), m, with NaN where it does not count."""
        keep = np.isfinite(depth)
        if self.mask is not None:
            keep &= self.mask
        rows, columns = np.nonzero(keep)
        z = depth[rows, columns].astype(np.float64)
        points = camera.rays()[rows, columns] * z[:, None] if self.roi is not None else None
        if points is None:  # only z is asked for
            points = np.zeros((len(z), 3))
            points[:, 2] = z
        inside = self._inside(points)
        keep[rows[~inside], columns[~inside]] = False
        return np.where(keep, depth, np.float32(np.nan))

    def _inside(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        keep = np.ones(len(points), dtype=bool)
        if self.depths is not None:
            keep &= (points[:, 2] >= self.depths[0]) & (points[:, 2] <= self.depths[1])
        if self.roi is not None:
            assert self.T_map_camera is not None
            p = points @ self.T_map_camera[:3, :3].T + self.T_map_camera[:3, 3]
            keep &= ((p >= np.array(self.roi[0::2])) & (p <= np.array(self.roi[1::2]))).all(axis=1)
        return keep
