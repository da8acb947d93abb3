"""Textures: where they lie on a geom, and what colour they have there.

Coordinates follow MuJoCo's GL renderer: the first row of a texture's data is at v = 0, and
`texrepeat` and `texuniform` scale them. Colours are looked up in linear light, averaged over the
pixel's footprint: bilinear in a pyramid of halved images (Williams 1983), several times along
the footprint's sides where it is long.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from sim.engine import mujoco

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

TAPS = 8
"""Most look-ups along each side of a pixel's footprint."""

FACES = 6


def texture_of(model: mujoco.MjModel, geom: int) -> int:
    """The id of the colour texture of a geom, -1 if it has none."""
    material = int(model.geom_matid[geom])
    if material < 0:
        return -1
    roles = mujoco.mjtTextureRole
    both = (roles.mjTEXROLE_RGB, roles.mjTEXROLE_RGBA)
    return max(int(model.mat_texid[material, int(role)]) for role in both)


@dataclass(frozen=True)
class Textures:
    """The pyramids of a model's textures, in one array; texture k's level l starts at a texel.

    A cube's six faces lie one below the other in every level.
    """

    texels: NDArray[np.float32]
    """(n, 3) linear RGB."""
    start: Indices
    """(ntex, levels)."""
    size: Indices
    """(ntex, levels, 2) height and width (of one face)."""
    levels: Indices
    """(ntex,) number of levels."""
    cube: NDArray[np.bool_]
    """(ntex,) cube or sky box."""

    @staticmethod
    def of_model(model: mujoco.MjModel) -> Textures:
        """Decode every texture of a model."""
        pyramids = [_pyramid(model, k) for k in range(model.ntex)]
        most = max((len(p) for p in pyramids), default=1)
        start = np.zeros((model.ntex, most), np.int64)
        size = np.zeros((model.ntex, most, 2), np.int64)
        texels, count = [np.zeros((0, 3), np.float32)], 0
        for k, pyramid in enumerate(pyramids):
            for level, faces in enumerate(pyramid):
                start[k, level], size[k, level] = count, faces.shape[1:3]
                texels.append(faces.reshape(-1, 3))
                count += len(texels[-1])
        return Textures(
            np.concatenate(texels),
            start,
            size,
            np.array([len(p) for p in pyramids], np.int64),
            np.asarray(model.tex_type) != mujoco.mjtTexture.mjTEXTURE_2D,
        )


def _pyramid(model: mujoco.MjModel, texture: int) -> list[NDArray[np.float32]]:
    """Images (faces, height, width, 3), each half as wide as the one before."""
    height, width = int(model.tex_height[texture]), int(model.tex_width[texture])
    channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    data = model.tex_data[start : start + height * width * channels]
    faces = 1 if model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D else height // width
    pixels = data.reshape(faces, -1, width, channels)[..., [0, 1, 2] if channels > 2 else [0] * 3]
    as_stored = model.tex_colorspace[texture] == mujoco.mjtColorSpace.mjCOLORSPACE_LINEAR
    images = [(_LINEAR if not as_stored else np.linspace(0, 1, 256, dtype="f4"))[pixels]]
    while max(images[-1].shape[1:3]) > 1:
        images.append(_halved(_halved(images[-1], 1), 2))
    return images


def _halved(image: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Half as many texels along an axis (rounded up), each the mean of what it covers."""
    n = image.shape[axis]
    if n % 2 == 0:
        shape = (*image.shape[:axis], n // 2, 2, *image.shape[axis + 1 :])
        return image.reshape(shape).mean(axis + 1)
    half = (n + 1) // 2
    sums = np.concatenate([np.zeros_like(image.take([0], axis)), image.cumsum(axis, float)], axis)
    edge = np.linspace(0.0, n, half + 1)
    low = np.minimum(edge.astype(int), n - 1)
    share = (edge - low).reshape([-1 if a == axis else 1 for a in range(4)])
    upto = sums.take(low, axis) * (1.0 - share) + sums.take(low + 1, axis) * share
    return np.asarray(np.diff(upto, axis=axis) * (half / n), np.float32)


def _srgb_to_linear(value: Array) -> Array:
    """IEC 61966-2-1."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: Array) -> Array:
    """The screen value 0..1 of linear light 0..1 (IEC 61966-2-1)."""
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1.0 / 2.4) - 0.055)


_LINEAR = _srgb_to_linear(np.linspace(0.0, 1.0, 256)).astype(np.float32)


def coordinates(
    model: mujoco.MjModel, geom: int, vertices: Array, faces: Indices
) -> NDArray[np.float64] | None:
    """Texture coordinates (m, 3, 3) of the corners of a geom's triangles; None: no texture.

    `vertices` (n, 3) and `faces` (m, 3) are in the geom's frame. For a cube texture the
    coordinates are a direction, else u, v and 0.
    """
    texture = texture_of(model, geom)
    if texture < 0:
        return None
    kinds = mujoco.mjtGeom
    kind, material = kinds(int(model.geom_type[geom])), int(model.geom_matid[geom])
    size = np.array(model.geom_size[geom], float)
    if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
        height = size[1] + (0.0 if kind == kinds.mjGEOM_CYLINDER else size[0])
        size = np.array([size[0], size[0], height])
    uniform = bool(model.mat_texuniform[material])
    corner = vertices[faces]
    if model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D:
        if kind in (kinds.mjGEOM_MESH, kinds.mjGEOM_HFIELD):
            return corner * size if uniform else corner
        return corner if uniform or size[0] == 0.0 else corner / np.where(size > 0.0, size, 1.0)
    scale = model.mat_texrepeat[material] * (size[:2] if uniform else 1.0)
    uv = np.zeros(corner.shape)
    mesh = int(model.geom_dataid[geom])
    if kind == kinds.mjGEOM_MESH and model.mesh_texcoordadr[mesh] >= 0:
        at, first = int(model.mesh_texcoordadr[mesh]), int(model.mesh_faceadr[mesh])
        index = model.mesh_facetexcoord[first : first + len(faces)]
        uv[..., :2] = model.mesh_texcoord[at + index] * scale
    elif kind in (kinds.mjGEOM_MESH, kinds.mjGEOM_HFIELD) or size[0] == 0.0:
        # Laid from above, its middle at the origin.
        scale = model.mat_texrepeat[material] / (1.0 if uniform or size[0] == 0.0 else size[:2])
        uv[..., :2] = 0.5 + 0.5 * corner[..., :2] * scale * [1.0, -1.0]
    else:
        uv[..., :2] = _wrapped(kind, size, corner) * scale
    return uv


def _wrapped(kind: mujoco.mjtGeom, size: Array, corner: Array) -> Array:
    """A primitive's own coordinates (m, 3, 2), 0 to 1: once round it, or once over each face."""
    kinds = mujoco.mjtGeom
    flat = 0.5 + 0.5 * corner / np.where(size > 0.0, size, 1.0)
    if kind == kinds.mjGEOM_PLANE:
        return np.stack([flat[..., 0], 1.0 - flat[..., 1]], axis=-1)
    if kind == kinds.mjGEOM_BOX:
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        axis = np.abs(normal).argmax(axis=1)
        across, down = np.array([1, 0, 0])[axis], np.array([2, 2, 1])[axis]
        u, v = (np.take_along_axis(flat, a[:, None, None], axis=2)[..., 0] for a in (across, down))
        return np.stack([u, 1.0 - v], axis=-1)
    round_it = np.arctan2(corner[..., 1] / size[1], corner[..., 0] / size[0]) / (2.0 * np.pi) % 1.0
    pole = np.abs(corner[..., :2]).max(axis=-1) < 1e-9 * size.max()
    others = np.where(pole, np.nan, round_it)
    others += (np.nanmax(others, axis=1, keepdims=True) - others > 0.5) * 1.0  # across the seam
    u = np.where(pole, np.nanmean(others, axis=1, keepdims=True), others)
    if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
        down = np.arccos(np.clip(corner[..., 2] / size[2], -1.0, 1.0)) / np.pi
        return np.stack([u, down], axis=-1)
    uv = np.stack([u, 1.0 - flat[..., 2]], axis=-1)
    if kind == kinds.mjGEOM_CYLINDER:
        lid = np.ptp(corner[..., 2], axis=1) == 0.0
        uv[lid] = flat[lid, :, :2]
    return uv


@nb.njit(cache=True, nogil=True, inline="always")
def _bilinear(texels, start, height, width, u, v, wrap, colour):
    """Add the colour at (u, v), in texels, to `colour`."""
    x, y = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
    a, b = u - 0.5 - x, v - 0.5 - y
    x1, y1 = x + 1, y + 1
    if x < 0 or y < 0 or x1 >= width or y1 >= height:
        if wrap:
            x, x1, y, y1 = x % width, x1 % width, y % height, y1 % height
        else:
            x, x1 = min(max(x, 0), width - 1), min(max(x1, 0), width - 1)
            y, y1 = min(max(y, 0), height - 1), min(max(y1, 0), height - 1)
    here, below = start + y * width, start + y1 * width
    w00, w10, w01, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    for c in range(3):
        colour[c] += (
            w00 * texels[here + x, c]
            + w10 * texels[here + x1, c]
            + w01 * texels[below + x, c]
            + w11 * texels[below + x1, c]
        )


@nb.njit(cache=True, nogil=True)
def sample(texels, start, size, levels, face, uv, ux, vx, uy, vy, wrap, colour):
    """Fill `colour` (3,) with a texture's mean over a pixel.

    start, size and levels are those of one texture; (ux, vx) and (uy, vy) are the footprint's
    sides, in coordinates that run from 0 to 1 over the image.
    """
    height, width = size[0, 0], size[0, 1]
    side_x = np.hypot(ux * width, vx * height)
    side_y = np.hypot(uy * width, vy * height)
    if not abs(uv[0]) + abs(uv[1]) + side_x + side_y < 1e9:  # a ray along the surface
        colour[:] = texels[start[levels - 1] + face]
        return
    # The level at which the shorter side is 1 to 2 texels, unless that takes too many look-ups
    # along the longer one: two for every texel.
    level, short, long = 0, min(side_x, side_y), max(side_x, side_y)
    while level < levels - 1 and (short >= 2.0 or long > 0.5 * TAPS):
        level, short, long = level + 1, 0.5 * short, 0.5 * long
    each = 2.0 / 2**level
    nx = min(max(int(np.ceil(each * side_x)), 2), TAPS)
    ny = min(max(int(np.ceil(each * side_y)), 2), TAPS)
    height, width = size[level, 0], size[level, 1]
    first = start[level] + face * height * width
    colour[:] = 0.0
    for i in range(nx):
        p = (i + 0.5) / nx - 0.5
        for j in range(ny):
            q = (j + 0.5) / ny - 0.5
            u, v = uv[0] + p * ux + q * uy, uv[1] + p * vx + q * vy
            _bilinear(texels, first, height, width, u * width, v * height, wrap, colour)
    colour /= nx * ny


@nb.njit(cache=True, nogil=True)
def onto_cube(here, right, below):
    """The face of a cube that a direction (3,) meets; it and its sides become u and v there.

    The table of OpenGL 4.6, section 8.13.
    """
    x, y, z = here[0], here[1], here[2]
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, u, v, m = (0, 2, 1, 0) if x > 0.0 else (1, 2, 1, 0)
        su, sv = (-1.0 if x > 0.0 else 1.0), -1.0
    elif ay >= az:
        face, u, v, m = (2, 0, 2, 1) if y > 0.0 else (3, 0, 2, 1)
        su, sv = 1.0, (1.0 if y > 0.0 else -1.0)
    else:
        face, u, v, m = (4, 0, 1, 2) if z > 0.0 else (5, 0, 1, 2)
        su, sv = (1.0 if z > 0.0 else -1.0), -1.0
    far = max(abs(here[m]), 1e-12)
    sign = 1.0 if here[m] > 0.0 else -1.0
    p, q = su * here[u] / far, sv * here[v] / far
    for side in (right, below):
        grow = sign * side[m]
        a, b = (su * side[u] - p * grow) / far, (sv * side[v] - q * grow) / far
        side[0], side[1] = 0.5 * a, 0.5 * b
    here[0], here[1] = 0.5 + 0.5 * p, 0.5 + 0.5 * q
    return face
