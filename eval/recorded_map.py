"""The depth map as a recording shows it: a thinned mesh and a small picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from depthba.depth_map import DepthMap
from depthba.picture import relief_image

Floats = NDArray[np.float64]

MESH_NODES = 9_000
"""About so many nodes are recorded per step: 16 bytes each."""
PICTURE_SIDE = 360
FINAL_SIDE = 1200
"""Largest side of the picture from above, pixels."""
MESH_BYTES = 7_000_000
"""Once the meshes take so much, only the first of each grid and the last are recorded."""
VISIBLE = 0.002
"""Changes below this share of the map's height range are not recorded again."""
GROUND = (233, 233, 236)


class RecordedMap:
    """Records one map over the iterations."""

    def __init__(self) -> None:
        """Begin with nothing recorded."""
        self._grid: tuple[Any, ...] = ()
        self._shown: Floats = np.zeros((0, 0))
        self._known: NDArray[np.bool_] = np.zeros((0, 0), dtype=bool)
        self._range: tuple[float, float] | None = None
        self._bytes = 0

    def log(self, rec: rr.RecordingStream, depth_map: DepthMap, *, final: bool = False) -> None:
        """Record the map at the stream's present time, unless it looks as it did before.

        Args:
            rec: where to.
            depth_map: the map.
            final: record it in any case, and in more detail.

        """
        heights = depth_map.heights
        known = np.isfinite(heights)
        if known.sum() < 4:
            return
        if self._range is None or final:
            low, high = np.quantile(heights[known], [0.01, 0.99])
            self._range = float(low), float(high)
        filled = filled_heights(depth_map)
        grid = (depth_map.shape, depth_map.origin, depth_map.spacing)
        same_grid = grid == self._grid and np.mean(known != self._known) < 0.01
        span = max(self._range[1] - self._range[0], 1e-9)
        if same_grid and not final:
            changed = float(np.mean(np.abs(filled - self._shown)))
            if changed < VISIBLE * span or self._bytes > MESH_BYTES:
                return
        step = int(np.ceil(np.sqrt(heights.size / (MESH_NODES * (4 if final else 1)))))
        self._mesh(rec, depth_map, filled, step, same_grid and not final)
        side = FINAL_SIDE if final else PICTURE_SIDE
        rec.log("map/picture", picture(depth_map, self._range, side))
        self._shown = filled
        if not same_grid:
            self._grid, self._known = grid, known

    def _mesh(
        self,
        rec: rr.RecordingStream,
        depth_map: DepthMap,
        filled: Floats,
        step: int,
        same_triangles: bool,
    ) -> None:
        """Record vertices and their colours, and the triangles where they changed."""
        assert self._range is not None
        thin = thinned(depth_map, filled, step)
        vertices = thin.vertices().reshape(-1, 3).astype(np.float32)
        colours = relief_image(thin, *self._range).reshape(-1, 4)
        self._bytes += vertices.nbytes + colours.nbytes
        if same_triangles:
            rec.log(
                "map/surface",
                rr.Mesh3D.from_fields(vertex_positions=vertices, vertex_colors=colours),
            )
            return
        faces = triangles(np.isfinite(depth_map.heights[::step, ::step]))
        rec.log(
            "map/surface",
            rr.Mesh3D(vertex_positions=vertices, triangle_indices=faces, vertex_colors=colours),
        )


def filled_heights(depth_map: DepthMap) -> Floats:
    """Return (ny, nx) heights, m; where nothing was seen, that of the nearest node that was."""
    known = np.isfinite(depth_map.heights)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(depth_map.heights[tuple(nearest)])


def thinned(depth_map: DepthMap, heights: Floats, step: int) -> DepthMap:
    """Return every ``step``-th node of a map, with other heights (ny, nx) in place of its own."""
    return DepthMap(
        heights=heights[::step, ::step],
        origin=depth_map.origin,
        spacing=step * depth_map.spacing,
        T_map_world=depth_map.T_map_world,
        count=depth_map.count[::step, ::step],
        sigma=depth_map.sigma[::step, ::step],
    )


def triangles(known: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Return (m, 3), two triangles for each cell whose four nodes are known."""
    ny, nx = known.shape
    node = np.arange(ny * nx, dtype=np.uint32).reshape(ny, nx)
    whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    a, b, c, d = (n[whole] for n in (node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def picture(depth_map: DepthMap, span: tuple[float, float], side: int) -> rr.EncodedImage:
    """Return the map from above as JPEG, north up, no side longer than ``side`` pixels.

    The colours span the heights ``span``, m.
    """
    rgba = relief_image(depth_map, *span)[::-1].astype(np.float32)
    alpha = rgba[..., 3:] / 255.0
    rgb = alpha * rgba[..., :3] + (1 - alpha) * np.array(GROUND, np.float32)
    scale = side / max(rgb.shape[:2])
    if scale < 1:
        rgb = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    bgr = np.ascontiguousarray(np.rint(rgb[..., ::-1]).astype(np.uint8))
    data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
    return rr.EncodedImage(contents=data, media_type="image/jpeg")
