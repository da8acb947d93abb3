"""The markers of a scene: geoms called `marker_NAME`, discs that lie on the floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from depthba.camera import Camera
from depthba.se3 import inverse
from sim.engine import mujoco
from sim.rendering.raycast import Hits

Array = NDArray[np.float64]

PREFIX = "marker_"

FEWEST = 5
"""Pixels that a marker must cover to count as seen."""

WHOLE = 0.9
"""Share of its disc's pixels that must be in sight: the mean of a half-hidden disc is off."""

RINGS, SPOKES = 20, 36
"""Pieces of a disc that its observation is averaged over."""


@dataclass(frozen=True)
class Disc:
    """A marker in the scene."""

    name: str
    geom: int
    p_world: Array
    """(3,) centre of its upper face, m."""
    normal: Array
    """(3,) of its upper face."""
    radius: float


def discs_of(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Disc, ...]:
    """The markers of a model at the pose in `data`: cylinders whose name begins with `marker_`."""
    found = []
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if not name.startswith(PREFIX):
            continue
        normal = data.geom_xmat[geom].reshape(3, 3)[:, 2].copy()
        radius, half = model.geom_size[geom, :2]
        top = data.geom_xpos[geom] + normal * half
        found.append(Disc(name.removeprefix(PREFIX), geom, top, normal, float(radius)))
    return tuple(found)


def observe(
    disc: Disc, camera: Camera, T_world_camera: Array, hits: Hits, depth: Array
) -> Array | None:
    """Where a frame sees a marker: the mean (3,) over the disc as measured, camera frame, m.

    The mean is over the disc's area, each piece of which is off by what the nearest pixel that
    shows the disc is off: over those pixels alone it would hang on how their raster meets the
    outline, by half a millimetre at 3 m, alike for all frames of a station.

    `depth` is what the sensor measured (NaN: nothing), `hits` says which pixels show the disc. None
    where the disc leaves the image, is mostly hidden, or covers too few pixels.
    """
    T_camera_world = inverse(T_world_camera)
    centre = T_camera_world[:3, :3] @ disc.p_world + T_camera_world[:3, 3]
    if centre[2] <= 0.0:
        return None
    u, v = camera.project(centre[None])[0]
    reach = 1.5 * camera.fx * disc.radius / centre[2]
    if not (reach <= u <= camera.width - 1 - reach and reach <= v <= camera.height - 1 - reach):
        return None
    points = np.asarray(camera.backproject(np.where(hits.geom == disc.geom, depth, np.nan)))
    # Pixels that the whole disc covers: its area, foreshortened, over that of a pixel.
    facing = abs(float(disc.normal @ (T_world_camera[:3, 3] - disc.p_world))) / centre[2]
    pixels = np.pi * disc.radius**2 * facing * camera.fx * camera.fy / centre[2] ** 2
    if len(points) < max(FEWEST, WHOLE * pixels - 2.0 * np.sqrt(pixels)):
        return None
    normal = T_camera_world[:3, :3] @ disc.normal
    longer = points @ normal / float(centre @ normal)  # than the ray to the disc's plane
    pieces = centre + disc.radius * _pieces(normal)
    _, nearest = cKDTree(camera.project(points)).query(camera.project(pieces))
    return np.asarray((pieces * longer[nearest, None]).mean(axis=0))


def _pieces(normal: Array) -> Array:
    """Return (n, 3) points of equal shares of a unit disc, whose mean is its centre."""
    across = np.linalg.svd(normal[None])[2][1:]
    angle = np.arange(SPOKES) * 2 * np.pi / SPOKES
    radius = np.sqrt((np.arange(RINGS) + 0.5) / RINGS)
    spokes = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ across
    return np.asarray((radius[:, None, None] * spokes).reshape(-1, 3))
