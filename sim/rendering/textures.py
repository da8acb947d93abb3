"""Textures: where they lie on a geom, and what colour they have there.

Coordinates follow MuJoCo's GL renderer: the first row of a texture's data is at v = 0, and
`texrepeat` and `texuniform` scale them. Images are kept in linear light, as pyramids of halved
images (Williams 1983).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.engine import mujoco

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


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
