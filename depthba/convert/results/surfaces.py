"""The merged cloud, the height map as GeoTIFF or PNG, and the map's mesh."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import durable
from depthba.convert.clouds import cloud_files
from depthba.convert.packages import package
from depthba.convert.results.outcome import Outcome, ResultFormat
from depthba.convert.writing import write_png
from depthba.depth_map import DepthMap
from depthba.errors import DatasetError, RunError

Array = NDArray[np.float64]

NOTHING = -9999.0
"""In a GeoTIFF, where nothing was seen."""
_METRE, _USER, _POINT, _PROJECTED = 9001, 32767, 2, 1


def write_cloud(outcome: Outcome, path: Path) -> None:
    """Write the merged cloud with its colours, world coordinates, m."""
    if outcome.cloud is None or not outcome.cloud.is_file():
        raise RunError(f"{outcome.path}: has no cloud.ply, expected a run folder")
    data = outcome.cloud.read_bytes()
    points, colours = coloured_ply(data, str(outcome.cloud))
    cloud_files.write(path, points, colours)


def coloured_ply(data: bytes, name: str) -> tuple[Array, NDArray[np.uint8]]:
    """Read points (n, 3) and colours (n, 3) of the PLY that `depthba.ply.write_ply` writes."""
    kind = np.dtype([(axis, "<f4") for axis in "xyz"] + [(c, "u1") for c in ("r", "g", "b")])
    head, mark, body = data.partition(b"end_header\n")
    if not mark or len(body) % kind.itemsize or b"property uchar red" not in head:
        raise DatasetError(f"{name}: expected a cloud.ply with colours, as register writes it")
    rows = np.frombuffer(body, kind)
    return (
        np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64),
        np.stack([rows[c] for c in "rgb"], axis=1),
    )


def write_geotiff(outcome: Outcome, path: Path) -> None:
    """Write the heights as a GeoTIFF of float32 in the map frame, m, with north (y) up.

    The nodes of the map are points (GTRasterType: pixel is point), the coordinate system is a local
    one in metres; T_map_world stands in the image's description.
    """
    tifffile = package("tifffile", "GeoTIFF")
    depth_map = outcome.map()
    heights = np.flipud(np.where(np.isnan(depth_map.heights), NOTHING, depth_map.heights))
    x, y = depth_map.origin
    top = y + depth_map.spacing * (depth_map.shape[0] - 1)
    s = depth_map.spacing
    # GTModelType, GTRasterType, ProjectedCSType, ProjLinearUnits, each as id, place, count, value
    keys = [1, 1, 0, 4, 1024, 0, 1, _PROJECTED, 1025, 0, 1, _POINT]
    keys += [3072, 0, 1, _USER, 3076, 0, 1, _METRE]
    tags = [
        (33550, "d", 3, (s, s, 0.0), True),
        (33922, "d", 6, (0.0, 0.0, 0.0, x, top, 0.0), True),
        (34735, "H", len(keys), tuple(keys), True),
        (42113, "s", 0, f"{NOTHING:g}", True),
    ]
    part = path.with_name(f".{path.name}{durable.PART}")
    tifffile.imwrite(
        part,
        heights.astype(np.float32),
        photometric="minisblack",
        compression="zlib",
        description=json.dumps({"T_map_world": depth_map.T_map_world.tolist(), "unit": "m"}),
        metadata=None,
        extratags=tags,
    )
    part.replace(path)


def write_png_map(outcome: Outcome, path: Path) -> None:
    """Write the heights as a 16-bit PNG with y up, 0 where nothing was seen, and a JSON beside it.

    The JSON says how: height = offset_m + scale_m * pixel; x and y of the upper left pixel, and the
    distance of pixels.
    """
    depth_map = outcome.map()
    seen = np.isfinite(depth_map.heights)
    low = float(np.nanmin(depth_map.heights)) if seen.any() else 0.0
    high = float(np.nanmax(depth_map.heights)) if seen.any() else 0.0
    scale = max((high - low) / 65534, 1e-9)
    steps = np.where(seen, np.rint((depth_map.heights - low) / scale) + 1, 0)
    write_png(path, np.ascontiguousarray(np.flipud(steps)).astype(np.uint16))
    x, y = depth_map.origin
    said: dict[str, Any] = {
        "scale_m": scale,
        "offset_m": low - scale,
        "nothing": 0,
        "upper_left_m": [x, y + depth_map.spacing * (depth_map.shape[0] - 1)],
        "spacing_m": depth_map.spacing,
        "T_map_world": depth_map.T_map_world.tolist(),
    }
    durable.write_json(path.with_suffix(".json"), said)


def write_mesh(outcome: Outcome, path: Path) -> None:
    """Write the map as a mesh in world coordinates, coloured by height: PLY or GLB.

    GLB has y up by definition: its node turns the world's z there.
    """
    from depthba.picture import height_colours

    trimesh = package("trimesh", "a mesh")
    if path.suffix.lower() not in (".ply", ".glb"):
        raise DatasetError(f"{path}: suffix {path.suffix!r}, expected .ply or .glb of a mesh")
    vertices, faces, heights = triangles(outcome.map())
    if not len(faces):
        raise RunError(f"{outcome.path}: its map has no cell with three seen nodes")
    mesh = trimesh.Trimesh(
        vertices, faces, vertex_colors=height_colours(heights), process=False, validate=False
    )
    if path.suffix.lower() == ".glb":
        scene = trimesh.Scene()
        T_gltf_world = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
        scene.add_geometry(mesh, node_name="map", transform=T_gltf_world)
        data = scene.export(file_type="glb")
    else:
        data = mesh.export(file_type="ply")
    durable.write_bytes(path, data)


def triangles(depth_map: DepthMap) -> tuple[Array, NDArray[np.int64], Array]:
    """Return vertices (n, 3), world, m; faces (m, 3), seen from above; heights (n,), map, m.

    A cell gives two triangles, or one where one of its four nodes was not seen.
    """
    seen = np.isfinite(depth_map.heights)
    number = np.full(depth_map.shape, -1, dtype=np.int64)
    number[seen] = np.arange(int(seen.sum()))
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    whole = (a >= 0) & (b >= 0) & (c >= 0) & (d >= 0)
    corners = [(a, b, d), (a, d, c), (a, b, c), (b, d, c)]
    usable = [whole | ((c < 0) & (a >= 0)), whole | ((b < 0) & (a >= 0))]
    usable += [(d < 0) & (a >= 0), (a < 0) & (b >= 0)]
    faces = []
    for (p, q, r), use in zip(corners, usable, strict=True):
        there = use & (p >= 0) & (q >= 0) & (r >= 0)
        faces.append(np.stack([p, q, r], axis=1)[there])
    return depth_map.vertices()[seen], np.concatenate(faces), depth_map.heights[seen]


FORMATS = (
    ResultFormat(
        "cloud", "the merged cloud", (".ply", ".pcd", ".xyz", ".las", ".laz"), write_cloud
    ),
    ResultFormat("geotiff", "the height map, float32", (".tif", ".tiff"), write_geotiff),
    ResultFormat("height-png", "the height map, 16 bit, and a JSON", (".png",), write_png_map),
    ResultFormat("mesh", "the map as a mesh", (".glb", ".ply"), write_mesh),
)
