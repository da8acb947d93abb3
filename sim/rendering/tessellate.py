"""Triangles of a compiled MuJoCo model, as the ray caster needs them.

Meshes, boxes and height fields are exact. Round shapes have 256 segments whose corners stand out as
far as their sides fall short: for a radius of 0.3 m that is 0.01 mm for a cylinder, 0.02 mm for a
sphere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sim.engine import mujoco
from sim.errors import SimulationError
from sim.rendering.creases import crease
from sim.rendering.textures import coordinates

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Floats = NDArray[np.float32]
Mesh = tuple[Array, Indices]
Shape = tuple[Array, Indices, Indices, Floats]
"""Vertices, faces, the curved ones among these, and their corners' normals."""

SEGMENTS = 256

UNSET = (0.5, 0.5, 0.5, 1.0)
"""The colour of a geom that was given none; then its material's counts."""

CREASE = np.radians(20.0)
"""Faces that meet at less than this angle stand for one curved surface."""

PLANE_REACH = 50.0
"""Half length at which an infinite plane is cut off, m."""


@dataclass(frozen=True)
class Triangles:
    """A triangle soup in world coordinates that remembers the geom of each triangle."""

    vertices: Array
    """(n, 3), m."""
    faces: Indices
    """(m, 3), counter-clockwise seen from outside."""
    geom: Indices
    """(m,) geom id of each face."""
    textured: Indices = field(default_factory=lambda: np.zeros(0, np.int64))
    """(k,) the faces that have a texture."""
    texcoord: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """(k, 3, 3) their corners' texture coordinates: u, v, 0; a direction into a cube texture."""
    curved: Indices = field(default_factory=lambda: np.zeros(0, np.int64))
    """(j,) the faces that stand for a curved surface."""
    corner_normals: Floats = field(default_factory=lambda: np.zeros((0, 3, 3), np.float32))
    """(j, 3, 3) that surface's outward normals at their corners."""


class Shapes:
    """The shapes of a model's visible geoms, each in its own frame: what no pose changes."""

    def __init__(
        self, model: mujoco.MjModel, groups: tuple[int, ...] = (0, 1, 2), segments: int = SEGMENTS
    ) -> None:
        """Cut up the geoms with alpha above 0 of these groups.

        SimulationError names a geom that has no triangles, or says that none is visible.
        """
        known: dict[tuple[object, ...], Shape] = {}
        self._placed: list[tuple[int, Shape]] = []
        textured, texcoord, first = [np.zeros(0, np.int64)], [np.zeros((0, 3, 3))], 0
        curved, faces = [np.zeros(0, np.int64)], []
        vertices = 0
        for geom in range(model.ngeom):
            if model.geom_group[geom] not in groups or _alpha(model, geom) == 0.0:
                continue
            kind, data = int(model.geom_type[geom]), int(model.geom_dataid[geom])
            key = (kind, data, *model.geom_size[geom])
            if key not in known:
                known[key] = _rounded(*_shape(model, geom, segments), kind)
            v, f, bent, _ = known[key]
            self._placed.append((geom, known[key]))
            laid = coordinates(model, geom, v, f)
            if laid is not None:
                textured.append(np.arange(first, first + len(f)))
                texcoord.append(laid)
            curved.append(bent + first)
            faces.append(f + vertices)
            first += len(f)
            vertices += len(v)
        if not self._placed:
            raise SimulationError("the scene has no visible geom")
        self._faces = np.concatenate(faces)
        self._geom = np.repeat(
            [geom for geom, _ in self._placed], [len(shape[1]) for _, shape in self._placed]
        )
        self._curved = np.concatenate(curved)
        self._textured, self._texcoord = np.concatenate(textured), np.concatenate(texcoord)

    def at(self, data: mujoco.MjData) -> Triangles:
        """Their triangles at the pose in `data`, which must hold the forward kinematics."""
        vertices, normals = [], []
        for geom, (v, _, _, bend) in self._placed:
            R = data.geom_xmat[geom].reshape(3, 3)
            vertices.append(np.einsum("ni,ji->nj", v, R) + data.geom_xpos[geom])
            normals.append(np.einsum("kci,ji->kcj", bend, R.astype(np.float32)))
        return Triangles(
            np.concatenate(vertices),
            self._faces,
            self._geom,
            self._textured,
            self._texcoord,
            self._curved,
            np.concatenate(normals),
        )


def triangles_of(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    groups: tuple[int, ...] = (0, 1, 2),
    segments: int = SEGMENTS,
) -> Triangles:
    """The triangles of every visible geom (alpha above 0, group in `groups`) at the pose in `data`.

    `data` must hold the forward kinematics. SimulationError names a geom that has no triangles.
    """
    return Shapes(model, groups, segments).at(data)


def _alpha(model: mujoco.MjModel, geom: int) -> float:
    own, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    return float(model.mat_rgba[material, 3] if material >= 0 and (own == UNSET).all() else own[3])


def _rounded(vertices: Array, faces: Indices, kind: int) -> Shape:
    """A shape with the normals of its curved faces; a height field has none, for speed."""
    kinds = mujoco.mjtGeom
    if kinds(kind) in (kinds.mjGEOM_PLANE, kinds.mjGEOM_BOX, kinds.mjGEOM_HFIELD):
        return vertices, faces, np.zeros(0, np.int64), np.zeros((0, 3, 3), np.float32)
    curved, normals = crease(vertices, faces, float(np.cos(CREASE)))
    return vertices, faces, curved, normals


def _shape(model: mujoco.MjModel, geom: int, segments: int) -> Mesh:
    kinds = mujoco.mjtGeom
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == kinds.mjGEOM_MESH:
        return _mesh(model, int(model.geom_dataid[geom]))
    if kind == kinds.mjGEOM_HFIELD:
        return _height_field(model, int(model.geom_dataid[geom]))
    makers: dict[int, Callable[[], Mesh]] = {
        int(kinds.mjGEOM_PLANE): lambda: _plane(size),
        int(kinds.mjGEOM_BOX): lambda: _box(size),
        int(kinds.mjGEOM_SPHERE): lambda: _ellipsoid(size[[0, 0, 0]], 0.0, segments),
        int(kinds.mjGEOM_ELLIPSOID): lambda: _ellipsoid(size, 0.0, segments),
        int(kinds.mjGEOM_CAPSULE): lambda: _ellipsoid(size[[0, 0, 0]], size[1], segments),
        int(kinds.mjGEOM_CYLINDER): lambda: _cylinder(size, segments),
    }
    if int(kind) not in makers:
        name = model.geom(geom).name or f"number {geom}"
        raise SimulationError(
            f"geom {name} is of kind {kinds(kind).name}, which cannot be rendered"
        )
    return makers[int(kind)]()


def _mesh(model: mujoco.MjModel, mesh: int) -> Mesh:
    v0, nv = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    f0, nf = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return model.mesh_vert[v0 : v0 + nv].astype(float), model.mesh_face[f0 : f0 + nf].astype(
        np.int64
    )


def _plane(size: Array) -> Mesh:
    x, y = (s if s > 0.0 else PLANE_REACH for s in size[:2])
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def _box(size: Array) -> Mesh:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = ([0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3])
    return signs * size, _split(np.array(quads))


def _split(quads: Indices) -> Indices:
    """Quads (n, 4), cut along their first diagonal."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _rings(rings: Array, bottom: Array, top: Array) -> Mesh:
    """A closed surface from rings (k, n, 3), listed upwards, and its two poles."""
    k, n = rings.shape[:2]
    index = np.arange(k * n).reshape(k, n)
    after = np.roll(index, -1, axis=1)
    quads = np.stack([index[:-1], after[:-1], after[1:], index[1:]], axis=-1).reshape(-1, 4)
    south = np.stack([np.full(n, k * n), after[0], index[0]], axis=-1)
    north = np.stack([np.full(n, k * n + 1), index[-1], after[-1]], axis=-1)
    vertices = np.concatenate([rings.reshape(-1, 3), bottom[None], top[None]])
    return vertices, np.concatenate([_split(quads), south, north])


def _circle(segments: int) -> Array:
    angle = 2.0 * np.pi * np.arange(segments) / segments
    radius = _middling(segments)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(segments)])


def _middling(segments: int) -> float:
    """The radius at which a polygon's corners stand out as far as its sides fall short of 1."""
    return 2.0 / (1.0 + float(np.cos(np.pi / segments)))


def _cylinder(size: Array, segments: int) -> Mesh:
    up = np.array([0.0, 0.0, size[1]])
    ring = _circle(segments) * size[0]
    return _rings(np.stack([ring - up, ring + up]), -up, up)


def _ellipsoid(axes: Array, stretch: float, segments: int) -> Mesh:
    """An ellipsoid; with `stretch` its halves are that far apart along z: a capsule."""
    half = segments // 4
    latitude = 0.5 * np.pi * np.arange(-half + 1, half) / half
    if stretch:  # the equator twice
        latitude = np.concatenate([latitude[:half], latitude[half - 1 :]])
    lift = np.where(np.arange(len(latitude)) < half, -stretch, stretch)[:, None, None]
    up = np.array([0.0, 0.0, 1.0])
    rings = (
        np.cos(latitude)[:, None, None] * _circle(segments) + np.sin(latitude)[:, None, None] * up
    )
    # Its sides are curved along the meridian too: corners out by as much again.
    rings = rings * _middling(segments) * axes + lift * up
    pole = up * (axes[2] + stretch)
    return _rings(rings, -pole, pole)


def _height_field(model: mujoco.MjModel, field: int) -> Mesh:
    """The top, split along (r, c)-(r+1, c+1) as MuJoCo does, with its skirt and base."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    start = model.hfield_adr[field]
    sx, sy, height, base = model.hfield_size[field]
    z = model.hfield_data[start : start + rows * columns].astype(float) * height
    y, x = np.meshgrid(np.linspace(-sy, sy, rows), np.linspace(-sx, sx, columns), indexing="ij")
    top = np.column_stack([x.ravel(), y.ravel(), z])
    index = np.arange(rows * columns).reshape(rows, columns)
    cells = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)
    rim = np.concatenate([index[0], index[1:, -1], index[-1, -2::-1], index[-2:0:-1, 0]])
    foot = top[rim] * [1.0, 1.0, 0.0] - [0.0, 0.0, base]
    low = np.arange(len(rim)) + len(top)
    skirt = np.stack([rim, low, np.roll(low, -1), np.roll(rim, -1)], axis=-1)
    corners = low[[0, columns - 1, columns + rows - 2, 2 * columns + rows - 3]]
    quads = np.concatenate([cells.reshape(-1, 4), skirt, corners[None, ::-1]])
    return np.concatenate([top, foot]), _split(quads)
