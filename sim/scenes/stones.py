"""Crushed stone and slag: families of convex shapes, and scattering them over a relief.

Crushed stone breaks into flat facets, so a stone is the intersection of random half-spaces; slag
cools into lumps, so it is the hull of points on a bumpy ellipsoid. Axes ratios follow the usual
range of crushed aggregate (b/a 0.65 to 0.95, c/b 0.45 to 0.7, the flatter of Zingg's classes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import HalfspaceIntersection

from sim.engine import mujoco
from sim.scenes.relief import Hull, Relief, frame, hull_of, turned

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Family:
    """A kind of stone: how it is shaped and coloured."""

    name: str
    lumpy: bool
    """True: rounded lumps (slag). False: flat facets (crushed stone)."""
    colours: tuple[tuple[float, float, float], ...]
    """Reflectances to choose from, linear RGB."""
    material: str = ""
    """Name of the model's material that says how it shines; none: matt."""


CRUSHED = Family(
    "stone",
    False,
    ((0.24, 0.225, 0.20), (0.18, 0.178, 0.175), (0.30, 0.28, 0.245), (0.21, 0.18, 0.15)),
)
CHIPS = Family("chip", False, CRUSHED.colours)
SLAG = Family(
    "slag", True, ((0.085, 0.082, 0.086), (0.12, 0.105, 0.095), (0.15, 0.10, 0.072)), "slag"
)

LOOSE = "loose_"
"""Names of geoms that nothing holds but their weight begin so."""


@dataclass(frozen=True)
class Shape:
    """A stone as a mesh of the model, lying on its flattest side (shortest axis along z)."""

    mesh: str
    diameter: float
    reach: float
    """Radius of the sphere around its origin that holds it, m."""
    hull: Hull
    family: Family


def make_shapes(
    spec: mujoco.MjSpec,
    rng: np.random.Generator,
    family: Family,
    diameters: Array,
    each: int,
) -> list[Shape]:
    """Add `each` shapes of every diameter (longest axis, m) to the model's meshes."""
    shapes = []
    for size, diameter in enumerate(diameters):
        for variant in range(each):
            hull = _lump(rng) if family.lumpy else _crushed(rng)
            extent = np.ptp(hull.vertices[:, :2], axis=0).max()
            hull = hull_of((hull.vertices - hull.vertices.mean(axis=0)) * (diameter / extent))
            name = f"{family.name}_{size}_{variant}"
            spec.add_mesh(
                name=name, uservert=hull.vertices.ravel(), userface=hull.faces.ravel().astype(int)
            )
            reach = float(np.linalg.norm(hull.vertices, axis=1).max())
            shapes.append(Shape(name, float(diameter), reach, hull, family))
    return shapes


def _axes(rng: np.random.Generator) -> Array:
    middle = rng.uniform(0.65, 0.95)
    return np.array([1.0, middle, middle * rng.uniform(0.45, 0.7)])


def _crushed(rng: np.random.Generator) -> Hull:
    count = int(rng.integers(11, 20))
    normals = _spread(rng, count)
    offsets = rng.uniform(0.72, 1.0, count)
    body = HalfspaceIntersection(np.column_stack([normals, -offsets]), np.zeros(3))
    return hull_of(body.intersections * _axes(rng))


def _lump(rng: np.random.Generator) -> Hull:
    points = _spread(rng, int(rng.integers(45, 80)))
    bumps = 1.0 + 0.12 * np.sin(points @ rng.normal(size=(3, 4)) * 2.0 + rng.uniform(0, 6, 4)).mean(
        1
    )
    return hull_of(points * bumps[:, None] * _axes(rng))


def _spread(rng: np.random.Generator, count: int) -> Array:
    """Directions (count, 3) spread evenly over the sphere (golden spiral), turned and jittered."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    angle = np.pi * (1.0 + 5.0**0.5) * k
    flat = np.sqrt(1.0 - z * z)
    points = np.column_stack([flat * np.cos(angle), flat * np.sin(angle), z])
    points = points @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points += rng.normal(scale=0.6 / np.sqrt(count), size=points.shape)
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True), float)


@dataclass(frozen=True)
class Keep:
    """A disc of the floor that stays free of stones longer than `above` m."""

    x: float
    y: float
    radius: float
    above: float = 0.0


def draw_diameters(
    rng: np.random.Generator, count: int, low: float, high: float, power: float
) -> Array:
    """Diameters whose number density falls as d ** -power between low and high m, largest first."""
    u = rng.random(count)
    e = 1.0 - power
    return np.sort((low**e + u * (high**e - low**e)) ** (1.0 / e))[::-1]


def scatter(
    spec: mujoco.MjSpec,
    rng: np.random.Generator,
    relief: Relief,
    shapes: list[Shape],
    diameters: Array,
    area: tuple[float, float, float, float],
    keep: tuple[Keep, ...] = (),
    repose: float = np.radians(37.0),
    name: str = "stone",
) -> None:
    """Drop stones one after another on the relief, each bedded into what already lies there.

    A stone that lands on a slope beyond the angle of repose rolls downhill until it is flatter, so
    heaps keep the look of tipped material. `area` is (xmin, xmax, ymin, ymax) m. Each stone takes
    the same numbers from `rng` whether or not it is kept: the others do not depend on it. They are
    called `loose_NAME_NUMBER`, and `settle` lets them fall.
    """
    by_size = sorted(shapes, key=lambda shape: shape.diameter)
    sizes = np.array([shape.diameter for shape in by_size])
    centres = np.array([[k.x, k.y, k.radius, k.above] for k in keep]).reshape(-1, 4)
    for number, diameter in enumerate(diameters):
        size = sizes[np.abs(sizes - diameter).argmin()]
        first, last = np.searchsorted(sizes, [0.999 * size, 1.001 * size])
        shape = by_size[int(rng.integers(first, last))]
        # Loads are tipped in heaps: of two places a stone often takes the higher.
        xs, ys = rng.uniform(area[0], area[1], 2), rng.uniform(area[2], area[3], 2)
        choosy = rng.random() < 0.4
        tilt, heading = rng.normal(scale=0.16, size=3), rng.uniform(0.0, 2.0 * np.pi)
        sink = rng.uniform(0.85, 0.96)
        colours = shape.family.colours
        colour = np.array(colours[int(rng.integers(len(colours)))]) * rng.uniform(0.75, 1.2)
        pick = int(np.argmax(relief.at(xs, ys))) if choosy else 0
        x, y = _roll(relief, float(xs[pick]), float(ys[pick]), shape.diameter, repose)
        inside = area[0] <= x <= area[1] and area[2] <= y <= area[3]
        near = np.hypot(centres[:, 0] - x, centres[:, 1] - y) < centres[:, 2] + 0.5 * shape.diameter
        if not inside or (near & (shape.diameter > centres[:, 3])).any():
            continue
        rotation = _lie(relief.slope(x, y, 0.5 * shape.diameter), tilt, heading)
        planes = turned(shape.hull.planes, rotation)
        z = relief.bed(planes, x, y, shape.reach, sink)
        add_mesh_geom(
            spec, shape.mesh, np.array([x, y, z]), rotation, colour,
            f"{LOOSE}{name}_{number}", shape.family.material,
        )  # fmt: skip


def _roll(
    relief: Relief, x: float, y: float, diameter: float, repose: float
) -> tuple[float, float]:
    for _ in range(12):
        gradient = relief.slope(x, y, 0.6 * diameter)
        steep = float(np.hypot(*gradient))
        if steep < np.tan(repose):
            break
        x, y = (np.array([x, y]) - 0.5 * diameter * gradient / steep).tolist()
    return x, y


def _lie(gradient: Array, tilt: Array, heading: float) -> Array:
    """A rotation that lays the flat side on the slope, give or take `tilt` (3,)."""
    up = np.array([-gradient[0], -gradient[1], 1.0])
    up = up / np.linalg.norm(up) + tilt
    return frame(up, np.array([np.cos(heading), np.sin(heading), 0.0]))


def add_mesh_geom(
    spec: mujoco.MjSpec,
    mesh: str,
    position: Array,
    rotation: Array,
    colour: Array,
    name: str = "",
    material: str = "",
) -> None:
    """Place a mesh of the model in the world; colour is linear RGB (3,)."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=mesh,
        pos=position,
        quat=quaternion,
        rgba=[*np.clip(colour, 0.0, 1.0), 1.0],
        material=material,
    )
