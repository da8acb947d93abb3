"""Colour from the same rays as the depth: material, one lamp with shadows, ambient light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera
from sim.engine import mujoco
from sim.raycast import Hits, RayScene, world_rays
from sim.seeds import stream

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


@dataclass(frozen=True)
class Finish:
    """How the geoms of a model answer to light."""

    reflectance: Array
    """(ngeom,) diffuse, 0 black to 1 white."""
    gloss: Array
    """(ngeom,) 0 matt to 1 mirror: the material's specular times its shininess."""

    @staticmethod
    def of_model(model: mujoco.MjModel) -> Finish:
        """From the geoms' colours and materials; a geom without a material is matt."""
        reflectance = colours_of(model) @ [0.2126, 0.7152, 0.0722]
        if model.nmat == 0:
            return Finish(reflectance, np.zeros(model.ngeom))
        material = np.asarray(model.geom_matid)
        gloss = np.asarray(model.mat_specular * model.mat_shininess, float)
        return Finish(reflectance, np.where(material >= 0, gloss[np.maximum(material, 0)], 0.0))


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
        directions = world_rays(camera, T_world_camera).reshape(-1, 3)[seen]
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


def _grain(points: Array) -> NDArray[np.float32]:
    """Brightness of loose ground: the speckles at points (n, 3), the same from every view."""
    where = (points[:, :2] * (1.0 / _GRAIN_CELL)).astype(np.int32) & (len(_GRAIN) - 1)
    return np.asarray(_GRAIN[where[:, 0], where[:, 1]])


def _speckles(cells: int = 1024) -> NDArray[np.float32]:
    """A tile of speckles one cell and four cells wide."""
    rng = stream(0, "speckles")
    fine = rng.random((cells, cells), np.float32)
    coarse = np.kron(rng.random((cells // 4, cells // 4), np.float32), np.ones((4, 4), np.float32))
    return np.asarray(1.0 + 0.35 * (fine - 0.5) + 0.30 * (coarse - 0.5), np.float32)


_GRAIN_CELL = 0.007
"""Width of a speckle, m."""

_GRAIN = _speckles()
