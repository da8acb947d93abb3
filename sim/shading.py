"""Colour from the same rays as the depth: material, one lamp with shadows, ambient light."""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera
from sim.engine import mujoco
from sim.raycast import Hits, RayScene
from sim.seeds import stream
from sim.tessellate import Triangles
from sim.textures import Textures, linear_to_srgb, onto_cube, sample, texture_of

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
    """The linear RGB reflectance (ngeom, 3) of every geom, before its texture.

    As in MuJoCo a geom's own colour counts where it is not the default one; else its material's.
    """
    own = np.asarray(model.geom_rgba, float)
    material = np.asarray(model.geom_matid)
    if model.nmat == 0:
        return own[:, :3]
    theirs = (material >= 0) & (own == _UNSET).all(axis=1)
    return np.where(theirs[:, None], model.mat_rgba[np.maximum(material, 0)], own)[:, :3]


_UNSET = (0.5, 0.5, 0.5, 1.0)
"""The colour of a geom that was given none."""


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
        self, scene: RayScene, model: mujoco.MjModel, lighting: Lighting = Lighting()
    ) -> None:
        """Gather the geoms' materials and lay the textures on the triangles."""
        self._scene = scene
        triangles = scene.triangles
        lamp = np.array(lighting.towards) / np.linalg.norm(lighting.towards)
        self._lamp = lamp
        self._light = np.array([*lamp, lighting.lamp, lighting.sky, lighting.ground])
        self._colour = colours_of(model)
        self._shine = _shine_of(model)
        self._loose = np.asarray(model.geom_type) == mujoco.mjtGeom.mjGEOM_HFIELD
        self._texture = np.array([texture_of(model, k) for k in range(model.ngeom)], np.int64)
        self._row = np.full(len(triangles.faces) if len(triangles.textured) else 1, -1, np.int32)
        self._row[triangles.textured] = np.arange(len(triangles.textured))
        self._laid = _affine(triangles)
        self._wrap = _leaves_the_image(triangles, model.ngeom)
        textures = Textures.of_model(model)
        self._textures = (
            textures.texels, textures.start, textures.size, textures.levels, textures.cube,
        )  # fmt: skip

    def paint(self, camera: Camera, T_world_camera: Array, hits: Hits) -> Image:
        """The colour image (height, width, 3) uint8 RGB that belongs to the hits of a view."""
        rays = camera.rays().reshape(-1, 3)
        triangle, geom = hits.triangle.ravel(), hits.geom.ravel()
        distance, T = hits.distance.ravel(), np.ascontiguousarray(T_world_camera, float)
        start = np.empty((len(triangle), 3), np.float32)
        pixel = np.empty(len(triangle), np.int64)
        normals = self._scene.normals
        count = _facing_lamp(triangle, distance, rays, T, normals, self._lamp, start, pixel)
        lit = np.zeros(len(triangle), np.bool_)
        lit[pixel[:count]] = ~self._scene.blocked(start[:count], self._lamp)
        image = np.empty((len(triangle), 3), np.uint8)
        _shade(
            triangle, geom, distance, lit, rays, T, 1.0 / camera.fx, 1.0 / camera.fy, normals,
            self._light, self._colour, self._shine, self._loose, _GRAIN,
            self._row, self._laid, self._texture, self._wrap, *self._textures, _SCREEN, image,
        )  # fmt: skip
        return image.reshape(camera.height, camera.width, 3)


def _shine_of(model: mujoco.MjModel) -> Array:
    """Strength and exponent of the highlight and the glow of every geom (ngeom, 3)."""
    if model.nmat == 0:
        return np.zeros((model.ngeom, 3))
    material = np.asarray(model.geom_matid)
    gloss = np.asarray(model.mat_specular * model.mat_shininess, float)
    exponent = 2.0 + 126.0 * np.asarray(model.mat_shininess, float)
    shine = np.column_stack([_HIGHLIGHT * gloss, exponent, model.mat_emission])
    return np.where((material >= 0)[:, None], shine[np.maximum(material, 0)], 0.0)


_HIGHLIGHT = 0.5
"""The highlight's strength on a mirror, relative to the lamp."""


def _affine(triangles: Triangles) -> Array:
    """Texture coordinates as functions of the place: (k, 3, 4), c = a x + b y + c z + d."""
    corner = triangles.vertices[triangles.faces[triangles.textured]]
    sides = corner[:, 1:] - corner[:, :1]
    change = triangles.texcoord[:, 1:] - triangles.texcoord[:, :1]
    gradient = np.einsum("kvs,ksc->kcv", np.linalg.pinv(sides), change)
    offset = triangles.texcoord[:, 0] - np.einsum("kcv,kv->kc", gradient, corner[:, 0])
    return np.concatenate([gradient, offset[..., None]], axis=2)


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


_GRAIN_CELL = 0.007
"""Width of a speckle, m."""

_GRAIN = _speckles()


@nb.njit(cache=True, nogil=True, inline="always")
def _place(rays, i, distance, T):
    """Direction and point of a pixel, world frame (6 values)."""
    x, y, z = rays[i, 0], rays[i, 1], rays[i, 2]
    dx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z
    dy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z
    dz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z
    t = distance[i]
    return dx, dy, dz, T[0, 3] + t * dx, T[1, 3] + t * dy, T[2, 3] + t * dz


@nb.njit(cache=True, nogil=True, inline="always")
def _seen_side(normals, k, dx, dy, dz):
    """A triangle's normal on the side it is seen from."""
    nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
    if nx * dx + ny * dy + nz * dz > 0.0:
        return -nx, -ny, -nz
    return nx, ny, nz


@nb.njit(cache=True, nogil=True)
def _facing_lamp(triangle, distance, rays, T, normals, lamp, start, pixel):
    """Fill the points (n, 3) that face the lamp and their pixels; return how many there are.

    They are a millimetre off the surface, so that it does not shade itself.
    """
    count = 0
    for i in range(len(triangle)):
        k = triangle[i]
        if k < 0:
            continue
        dx, dy, dz, px, py, pz = _place(rays, i, distance, T)
        nx, ny, nz = _seen_side(normals, k, dx, dy, dz)
        if nx * lamp[0] + ny * lamp[1] + nz * lamp[2] > 0.0:
            start[count, 0] = px + 1e-3 * nx
            start[count, 1] = py + 1e-3 * ny
            start[count, 2] = pz + 1e-3 * nz
            pixel[count] = i
            count += 1
    return count


@nb.njit(cache=True, nogil=True)
def _shade(
    triangle, geom, distance, lit, rays, T, step_x, step_y, normals,
    light, colour, shine, loose, grain,
    row, laid, texture, wrap, texels, start, size, levels, cube, screen, image,
):  # fmt: skip
    """Fill the image (n, 3) with screen values."""
    albedo, texel = np.empty(3), np.empty(3)
    here, right, below = np.empty(3), np.empty(3), np.empty(3)
    top = len(screen) - 1
    for i in range(len(triangle)):
        k = triangle[i]
        if k < 0:
            image[i] = screen[int(0.02 * top)]
            continue
        g = geom[i]
        dx, dy, dz, px, py, pz = _place(rays, i, distance, T)
        nx, ny, nz = _seen_side(normals, k, dx, dy, dz)
        albedo[:] = colour[g]
        r = row[k] if len(row) > 1 else -1
        if r >= 0:
            # The neighbouring pixels' rays meet the surface's plane there: the footprint's sides.
            depth, nd = distance[i], nx * dx + ny * dy + nz * dz
            slide_x = (nx * T[0, 0] + ny * T[1, 0] + nz * T[2, 0]) / nd
            slide_y = (nx * T[0, 1] + ny * T[1, 1] + nz * T[2, 1]) / nd
            hx, hy = depth * step_x, depth * step_y
            for c in range(3):
                a = laid[r, c]
                here[c] = a[0] * px + a[1] * py + a[2] * pz + a[3]
                along = a[0] * dx + a[1] * dy + a[2] * dz
                across = a[0] * T[0, 0] + a[1] * T[1, 0] + a[2] * T[2, 0]
                down = a[0] * T[0, 1] + a[1] * T[1, 1] + a[2] * T[2, 1]
                right[c] = hx * (across - slide_x * along)
                below[c] = hy * (down - slide_y * along)
            q = texture[g]
            face, repeat = 0, wrap[g]
            if cube[q]:
                face, repeat = onto_cube(here, right, below), False
            sample(
                texels, start[q], size[q], levels[q], face, here,
                right[0], right[1], below[0], below[1], repeat, texel,
            )  # fmt: skip
            for c in range(3):
                albedo[c] *= texel[c]
        if loose[g]:
            u, v = int(px / _GRAIN_CELL), int(py / _GRAIN_CELL)
            albedo *= grain[u & (len(grain) - 1), v & (len(grain) - 1)]
        up = 0.5 * (1.0 + nz)
        ambient = light[4] * up + light[5] * (1.0 - up) + shine[g, 2]
        sun, glint = 0.0, 0.0
        if lit[i]:
            facing = nx * light[0] + ny * light[1] + nz * light[2]
            if facing > 0.0:
                sun = light[3] * facing
                if shine[g, 0] > 0.0:  # Blinn 1977
                    length = np.sqrt(dx * dx + dy * dy + dz * dz)
                    bx, by, bz = (
                        light[0] - dx / length,
                        light[1] - dy / length,
                        light[2] - dz / length,
                    )
                    half = (nx * bx + ny * by + nz * bz) / np.sqrt(bx * bx + by * by + bz * bz)
                    glint = light[3] * shine[g, 0] * max(half, 0.0) ** shine[g, 1]
        for c in range(3):
            value = albedo[c] * (ambient + sun) + glint
            image[i, c] = screen[int(min(max(value, 0.0), 1.0) * top)]
