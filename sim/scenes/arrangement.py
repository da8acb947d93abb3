"""Pieces made of solids, how they come to rest, and how they are set out without touching."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from sim.engine import mujoco
from sim.rendering.raycast import RayScene
from sim.rendering.tessellate import Triangles
from sim.scenes.relief import frame
from sim.scenes.solids import Solid, joined

Array = NDArray[np.float64]
Colour = tuple[float, float, float]


def pick(rng: np.random.Generator, choices: tuple[Colour, ...]) -> Colour:
    """One of several colours."""
    return choices[int(rng.integers(len(choices)))]


MATERIALS = {
    "matt": (0.0, 0.0),
    "wood": (0.15, 0.15),
    "painted": (0.32, 0.32),
    "plastic": (0.4, 0.4),
    "rubber": (0.1, 0.1),
    "glazed": (0.64, 0.63),
    "steel": (0.71, 0.71),
    "polished": (0.9, 0.89),
}
"""Specular and shininess of each; their product is the gloss."""

HULL_CORNERS = 64
"""The arm's collision check takes a hull of so many corners: within 2 mm of a fruit's."""


class Part(NamedTuple):
    """A solid of one colour (linear RGB reflectance) and material, in its piece's frame."""

    solid: Solid
    colour: Colour
    material: str = "painted"


class Shelf(NamedTuple):
    """A level rectangle on top of a piece where others may stand: half lengths and height, m."""

    half_x: float
    half_y: float
    height: float


@dataclass(frozen=True)
class Piece:
    """An object: parts that move together. Its frame's z = 0 is what it stands on."""

    kind: str
    parts: tuple[Part, ...]
    shelf: Shelf | None = None

    def solid(self) -> Solid:
        """All its parts as one."""
        return joined(part.solid for part in self.parts)

    def moved(self, at: tuple[float, float, float], turn: Array | None = None) -> Piece:
        """The piece turned by (3, 3) and then shifted, m."""
        parts = tuple(part._replace(solid=part.solid.moved(at, turn)) for part in self.parts)
        return Piece(self.kind, parts)

    def settled(self) -> Piece:
        """The piece as it comes to lie: rolled from facet to facet of its hull, then at z = 0.

        It tips over the facet below its centre of mass until that facet is the lowest.
        """
        whole = self.solid()
        centre = _centroid(whole)
        hull = ConvexHull(whole.vertices)
        normals = hull.equations[:, :3]
        heights = -(hull.equations[:, 3] + np.einsum("ij,j->i", normals, centre))
        down = np.array([0.0, 0.0, -1.0])
        for _ in range(1000):
            towards = np.einsum("ij,j->i", normals, down)
            under = np.where(towards > 1e-9, heights / np.maximum(towards, 1e-9), np.inf)
            facet = int(np.argmin(under))
            if heights[facet] >= under[facet] * (1.0 - 1e-12):
                break
            down = normals[facet]
        ahead = np.eye(3)[int(np.argmin(np.abs(down)))]
        turn = frame(-down, ahead).T
        lowest = float(np.einsum("ij,j->i", whole.vertices, turn[2]).min())
        return self.moved((0.0, 0.0, -lowest), turn)


def _centroid(solid: Solid) -> Array:
    """The centre of a closed surface's volume (3,), m."""
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    six = np.einsum("ij,ij->i", np.cross(a, b), c)
    return np.asarray(np.einsum("i,ij->j", six, a + b + c) / (4.0 * six.sum()))


class Pose(NamedTuple):
    """Where a piece stands: x, y, z m and its heading, rad."""

    x: float
    y: float
    z: float = 0.0
    yaw: float = 0.0

    def at(self, other: Pose) -> Pose:
        """`other`, given in this pose's frame, in this pose's parent frame."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        x = self.x + cos * other.x - sin * other.y
        y = self.y + sin * other.x + cos * other.y
        return Pose(float(x), float(y), self.z + other.z, self.yaw + other.yaw)


class Bench:
    """Adds pieces to a model: a body each, `mug_1`, and one mesh for all parts that are equal."""

    def __init__(self, spec: mujoco.MjSpec) -> None:
        """Put the materials into the model."""
        self.spec = spec
        self._count: Counter[str] = Counter()
        self._meshes: dict[int, tuple[str, Solid]] = {}
        for name, (specular, shininess) in MATERIALS.items():
            spec.add_material(name=name, specular=specular, shininess=shininess)

    def add(self, piece: Piece, pose: Pose) -> None:
        """Stand a piece at a pose in the world."""
        self._count[piece.kind] += 1
        name = f"{piece.kind}_{self._count[piece.kind]}"
        half = 0.5 * pose.yaw
        body = self.spec.worldbody.add_body(
            name=name, pos=pose[:3], quat=[np.cos(half), 0.0, 0.0, np.sin(half)]
        )
        for number, part in enumerate(piece.parts):
            body.add_geom(
                name=f"{name}_{number}",
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=self._mesh(part.solid, f"{name}_{number}"),
                rgba=[*part.colour, 1.0],
                material=part.material,
            )

    def _mesh(self, solid: Solid, name: str) -> str:
        # The solid is kept, so that its id stays its own.
        key = id(solid.vertices)
        if key not in self._meshes:
            self._meshes[key] = name, solid
            self.spec.add_mesh(
                name=name,
                uservert=solid.vertices.ravel(),
                userface=solid.faces.ravel(),
                maxhullvert=HULL_CORNERS,
            )
        return self._meshes[key][0]


_FINE = 768
_COARSE = 12
_ANGLES = 2.0 * np.pi * np.arange(_FINE) / _FINE
_DIRECTIONS = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
_FEW = _DIRECTIONS[::_COARSE]


class Plot:
    """A level rectangle on which pieces stand clear of each other.

    A footprint is the hulls of a piece's parts, seen from above, by their support functions in 64
    directions. Two hulls are apart if one of these directions separates them, which is never
    wrong, though it may refuse what just fits.
    """

    def __init__(
        self,
        bench: Bench,
        half: tuple[float, float],
        at: Pose,
        gap: float = 0.004,
        height: float = np.inf,
    ) -> None:
        """The rectangle of half lengths around `at`; pieces stay `gap` m apart, below `height`."""
        self.bench, self.half, self.at, self.gap, self.height = bench, half, at, gap, height
        self._taken = np.empty((0, len(_FEW)))

    def scatter(self, rng: np.random.Generator, piece: Piece, tries: int = 300) -> Pose | None:
        """Stand a piece at a random free place, with any heading; returns its pose in the world.

        None if it found no place, or is too tall.
        """
        if max(float(part.solid.vertices[:, 2].max()) for part in piece.parts) > self.height:
            return None
        fine = np.stack([_support(hull) for hull in _footprint(piece)])
        every = _COARSE * np.arange(len(_FEW))
        for _ in range(-(-tries // 50)):
            at = rng.uniform(-1.0, 1.0, (50, 2)) * self.half
            shift = rng.integers(0, _FINE, 50)
            turned = fine[:, (every[None] - shift[:, None]) % _FINE]
            support = turned.transpose(1, 0, 2) + np.einsum("ti,di->td", at, _FEW)[:, None]
            free = np.flatnonzero(self._inside(support) & self._apart(support))
            if len(free):
                k = int(free[0])
                yaw = 2.0 * np.pi * float(shift[k]) / _FINE
                pose = self.at.at(Pose(float(at[k, 0]), float(at[k, 1]), yaw=yaw))
                self._taken = np.concatenate([self._taken, support[k]])
                self.bench.add(piece, pose)
                return pose
        return None

    def _inside(self, support: Array) -> NDArray[np.bool_]:
        quarter = len(_FEW) // 4
        reach = support[:, :, ::quarter].max(axis=1)
        return (reach <= np.tile(self.half, 2)).all(axis=1)

    def _apart(self, support: Array) -> NDArray[np.bool_]:
        if len(self._taken) == 0:
            return np.ones(len(support), bool)
        opposite = np.roll(self._taken, len(_FEW) // 2, axis=1)
        between = -(support[:, :, None] + opposite).min(axis=3)
        return (between >= self.gap).all(axis=(1, 2))


def _footprint(piece: Piece) -> list[Array]:
    """The corners (n, 2) of each part's hull seen from above."""
    flat = [part.solid.vertices[:, :2] for part in piece.parts]
    return [points[ConvexHull(points).vertices] for points in flat]


def _support(hull: Array) -> Array:
    """How far a hull (n, 2) reaches in each of the fine directions, m."""
    return np.asarray(np.einsum("di,ni->dn", _DIRECTIONS, hull).max(axis=1))


def drop(piece: Piece, onto: list[Solid]) -> float:
    """How far a piece above others falls, straight down, until it touches one, m.

    Corners against faces both ways: exact but for edges that cross, so for finely meshed bodies.
    """
    mine, others = piece.solid(), joined(onto)
    down = np.array([0.0, 0.0, -1.0])

    def gap(points: Array, surface: Solid, way: Array) -> float:
        rays = RayScene(
            Triangles(surface.vertices, surface.faces, np.zeros(len(surface.faces), np.int64))
        )
        hits = rays.cast(points, np.broadcast_to(way, points.shape)).distance
        return float(np.nanmin(hits, initial=np.inf))

    low, high = mine.vertices.min(axis=0), mine.vertices.max(axis=0)
    under = ((others.vertices >= low - 1e-3) & (others.vertices <= high + 1e-3))[:, :2].all(axis=1)
    under &= others.vertices[:, 2] < high[2]
    return min(gap(mine.vertices, others, down), gap(others.vertices[under], mine, -down))
