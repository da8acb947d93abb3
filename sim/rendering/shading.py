"""Colour from the same rays as the depth: material, texture, one lamp with shadows, the sky."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera
from sim.engine import mujoco
from sim.rendering import painting
from sim.rendering.raycast import Hits, RayScene
from sim.rendering.tessellate import UNSET, Triangles
from sim.rendering.textures import Textures, linear_to_srgb, texture_of
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
    shadows: bool = True
    """Whether what stands in the lamp's way casts a shadow."""

    @staticmethod
    def of_model(model: mujoco.MjModel) -> Lighting:
        """The first directional light of a model: where it shines from, and if it casts shadows.

        Without one, the lamp as it is here.
        """
        for light in range(model.nlight):
            if model.light_type[light] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
                x, y, z = (-float(v) for v in model.light_dir[light])
                return Lighting((x, y, z), shadows=bool(model.light_castshadow[light]))
        return Lighting()


def colours_of(model: mujoco.MjModel) -> Array:
    """The linear RGB reflectance (ngeom, 3) of every geom, before its texture.

    As in MuJoCo a geom's own colour counts where it is not the default one; else its material's.
    """
    own = np.asarray(model.geom_rgba, float)
    material = np.asarray(model.geom_matid)
    if model.nmat == 0:
        return own[:, :3]
    theirs = (material >= 0) & (own == UNSET).all(axis=1)
    return np.where(theirs[:, None], model.mat_rgba[np.maximum(material, 0)], own)[:, :3]


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
    """Paints views of one scene; what depends on the scene only is worked out once."""

    def __init__(
        self, scene: RayScene, model: mujoco.MjModel, lighting: Lighting | None = None
    ) -> None:
        """Gather the geoms' materials and the textures."""
        lighting = lighting or Lighting.of_model(model)
        self._shadows = lighting.shadows
        lamp = np.array(lighting.towards) / np.linalg.norm(lighting.towards)
        self._lamp = lamp
        self._light = np.array([*lamp, lighting.lamp, lighting.sky, lighting.ground])
        self._colour = colours_of(model)
        self._shine = _shine_of(model)
        self._loose = np.asarray(model.geom_type) == mujoco.mjtGeom.mjGEOM_HFIELD
        self._texture = np.array([texture_of(model, k) for k in range(model.ngeom)], np.int64)
        skies = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
        self._sky = int(skies[0]) if len(skies) else -1
        textures = Textures.of_model(model)
        self._textures = (
            textures.texels, textures.start, textures.size, textures.levels, textures.cube,
        )  # fmt: skip
        self._put_on(scene)

    def at(self, scene: RayScene) -> Painter:
        """The same for another pose of the model: textures are not decoded again."""
        painter = copy.copy(self)
        painter._put_on(scene)
        return painter

    def _put_on(self, scene: RayScene) -> None:
        triangles = scene.triangles
        self._scene = scene
        self._curved = _rows(triangles.curved, len(triangles.faces))
        self._row = _rows(triangles.textured, len(triangles.faces))
        self._wrap = _leaves_the_image(triangles, len(self._texture))

    def paint(self, camera: Camera, T_world_camera: Array, hits: Hits) -> Image:
        """The colour image (height, width, 3) uint8 RGB that belongs to the hits of a view."""
        rays, T = camera.rays(), np.ascontiguousarray(T_world_camera, float)
        triangles, normals = self._scene.triangles, self._scene.normals
        start = np.empty((hits.triangle.size, 3), np.float32)
        pixel = np.empty(hits.triangle.size, np.int64)
        count = painting.towards_lamp(
            hits.triangle, hits.distance, rays, T, normals, self._lamp, start, pixel
        )
        lit = np.zeros(hits.triangle.shape, np.bool_)
        hidden = self._shadows and self._scene.blocked(start[:count], self._lamp)
        lit.ravel()[pixel[:count]] = np.logical_not(hidden)
        image = np.empty((camera.height, camera.width, 3), np.uint8)
        painting.shade(
            hits.triangle, hits.geom, hits.distance, lit, rays, T, 1.0 / camera.fx, 1.0 / camera.fy,
            triangles.vertices, triangles.faces, normals,
            self._curved, triangles.corner_normals, self._row, triangles.texcoord,
            self._light, self._colour, self._shine, self._loose, _GRAIN,
            self._texture, self._wrap, self._sky, *self._textures, _SCREEN, image,
        )  # fmt: skip
        return image


def _rows(chosen: NDArray[np.int64], count: int) -> NDArray[np.int32]:
    """Where each of `count` triangles stands among the chosen, -1: nowhere; empty if none is."""
    row = np.full(count if len(chosen) else 0, -1, np.int32)
    row[chosen] = np.arange(len(chosen))
    return row


def _shine_of(model: mujoco.MjModel) -> Array:
    """Strength and exponent of the highlight, glow, and gloss of every geom (ngeom, 4)."""
    if model.nmat == 0:
        return np.zeros((model.ngeom, 4))
    material = np.asarray(model.geom_matid)
    gloss = np.asarray(model.mat_specular * model.mat_shininess, float)
    exponent = 2.0 + 126.0 * np.asarray(model.mat_shininess, float)
    shine = np.column_stack([_HIGHLIGHT * gloss, exponent, model.mat_emission, gloss])
    return np.where((material >= 0)[:, None], shine[np.maximum(material, 0)], 0.0)


_HIGHLIGHT = 0.5
"""The highlight's strength on a mirror, relative to the lamp."""


def _leaves_the_image(triangles: Triangles, count: int) -> NDArray[np.bool_]:
    """Which geoms repeat their texture; the others do not mix its opposite rims."""
    uv = triangles.texcoord[..., :2]
    outside = ((uv < -1e-6) | (uv > 1.0 + 1e-6)).any(axis=(1, 2))
    wrap = np.zeros(count, np.bool_)
    wrap[triangles.geom[triangles.textured[outside]]] = True
    return wrap


_SCREEN = np.asarray(255.0 * linear_to_srgb(np.linspace(0.0, 1.0, 8192)) + 0.5, np.uint8)
"""Linear light to screen values."""


def _speckles(cells: int = 1024) -> NDArray[np.float32]:
    """A tile of speckles one cell and four cells wide."""
    rng = stream(0, "speckles")
    fine = rng.random((cells, cells), np.float32)
    coarse = np.kron(rng.random((cells // 4, cells // 4), np.float32), np.ones((4, 4), np.float32))
    return np.asarray(1.0 + 0.35 * (fine - 0.5) + 0.30 * (coarse - 0.5), np.float32)


_GRAIN = _speckles()
