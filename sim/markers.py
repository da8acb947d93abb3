"""The markers of a scene: geoms called `marker_NAME`, discs that lie on the floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    """Where a frame sees a marker: the mean (3,) of the disc's measured points, camera frame, m.

    `depth` is what the sensor measured (NaN: nothing), `hits` says which pixels show the disc. None
    where the disc leaves the image, is mostly hidden, or covers too few pixels.
    """
    centre = _to_camera(T_world_camera, disc.p_world)
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
    return np.asarray(points.mean(axis=0))


def _to_camera(T_world_camera: Array, p_world: Array) -> Array:
    T = inverse(T_world_camera)
    return np.asarray(T[:3, :3] @ p_world + T[:3, 3])
