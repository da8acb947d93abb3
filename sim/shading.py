"""Colour from the same rays as the depth: material colour, one light with shadows, ambient light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera
from sim.engine import mujoco
from sim.raycast import Hits, RayScene

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Lighting:
    """A distant lamp and a sky that is brighter above."""

    towards: tuple[float, float, float] = (-0.55, 0.35, 0.76)
    """Direction to the lamp, world frame."""
    lamp: float = 1.75
    sky: float = 0.55
    ground: float = 0.18
    """Ambient light from below, from bounces."""


def colours_of(model: mujoco.MjModel) -> Array:
    """The linear RGB reflectance (ngeom, 3) of every geom: its material's, else its own."""
    own = np.asarray(model.geom_rgba[:, :3], float)
    material = np.asarray(model.geom_matid)
    if model.nmat == 0:
        return own
    return np.where((material >= 0)[:, None], model.mat_rgba[np.maximum(material, 0), :3], own)


class Painter:
    """Paints views of one scene; what depends on a triangle only is worked out once."""

    def __init__(
        self, scene: RayScene, model: mujoco.MjModel, lighting: Lighting = Lighting()
    ) -> None:
        """Prepare the triangles' colours under the lamp and in the shade."""
        self._scene = scene
        lamp = np.array(lighting.towards) / np.linalg.norm(lighting.towards)
        normal, geom = scene.normals, scene.triangles.geom
        colour = colours_of(model)[geom]
        sky = 0.5 * (1.0 + normal[:, 2:])
        facing = normal @ lamp
        self._lamp = lamp
        self._lit = facing > 0.0
        self._shade = (colour * (lighting.sky * sky + lighting.ground * (1.0 - sky))).astype("f4")
        self._sun = (colour * lighting.lamp * np.maximum(facing, 0.0)[:, None]).astype("f4")
        self._loose = (np.asarray(model.geom_type) == mujoco.mjtGeom.mjGEOM_HFIELD)[geom]

    def paint(self, camera: Camera, T_world_camera: Array, hits: Hits) -> Image:
        """The colour image (height, width, 3) uint8 RGB that belongs to the hits of a view."""
        seen = np.flatnonzero(hits.triangle.ravel() >= 0)
        triangle = hits.triangle.ravel()[seen]
        directions = camera.rays().reshape(-1, 3)[seen] @ T_world_camera[:3, :3].T
        points = T_world_camera[:3, 3] + directions * hits.distance.ravel()[seen, None]
        lit = np.flatnonzero(self._lit[triangle])
        # A millimetre off the surface, so that it does not shade itself.
        start = points[lit] + 1e-3 * self._scene.normals[triangle[lit]]
        lit = lit[~self._scene.blocked(start, self._lamp)]
        light = self._shade[triangle]
        light[lit] += self._sun[triangle[lit]]
        loose = np.flatnonzero(self._loose[triangle])
        light[loose] *= _grain(points[loose])[:, None]
        image = np.full((camera.height * camera.width, 3), 0.02, np.float32)
        image[seen] = light
        bright = _GAMMA[np.clip(image * (len(_GAMMA) - 1), 0, len(_GAMMA) - 1).astype(np.intp)]
        return np.asarray(bright.reshape(camera.height, camera.width, 3))


_GAMMA = np.asarray(255.0 * np.linspace(0.0, 1.0, 4096) ** (1.0 / 2.2) + 0.5, np.uint8)
"""Linear light to screen values."""


def _grain(points: Array) -> Array:
    """Brightness of loose ground: speckled in cells of 7 and 25 mm, the same from every view."""
    value = np.ones(len(points))
    for cell, strength in ((0.007, 0.35), (0.025, 0.30)):
        i, j = (np.floor(points[:, k] / cell).astype(np.int64) for k in (0, 1))
        mixed = (i * 73856093 ^ j * 19349663) & 0xFFFFFFFF
        mixed = ((mixed ^ (mixed >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
        mixed = (mixed ^ (mixed >> 13)) & 0xFFFF
        value += strength * (mixed / 65535.0 - 0.5)
    return value
