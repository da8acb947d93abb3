"""The depth map: heights over the nodes of a regular grid in the map frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DepthMap:
    """Heights over a regular grid in the x-y plane of the map frame.

    Node ``[y, x]`` stands at ``origin + spacing * (x, y)``. Between nodes the height is
    interpolated bilinearly.
    """

    heights: NDArray[np.float64]
    """(ny, nx), metres along the map's z axis; NaN where nothing was seen."""
    origin: tuple[float, float]
    """Map x and y of node [0, 0], metres."""
    spacing: float
    """Distance of neighbouring nodes, metres."""
    T_map_world: NDArray[np.float64]
    """(4, 4), takes world coordinates to map coordinates."""
    count: NDArray[np.int64]
    """(ny, nx), number of measured points that bear on the node."""
    sigma: NDArray[np.float64]
    """(ny, nx), standard deviation of the height given the poses, metres; NaN where nothing was
    seen."""

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return self.heights.shape[0], self.heights.shape[1]

    def vertices(self) -> NDArray[np.float64]:
        """Return the nodes in world coordinates, (ny, nx, 3); NaN where nothing was seen."""
        ny, nx = self.shape
        x, y = np.meshgrid(
            self.origin[0] + self.spacing * np.arange(nx),
            self.origin[1] + self.spacing * np.arange(ny),
        )
        p_map = np.stack([x, y, self.heights], axis=-1)
        R_map_world, t_map_world = self.T_map_world[:3, :3], self.T_map_world[:3, 3]
        return np.asarray((p_map - t_map_world) @ R_map_world)
