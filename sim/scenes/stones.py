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


CRUSHED = Family(
    "stone",
    False,
    ((0.24, 0.225, 0.20), (0.18, 0.178, 0.175), (0.30, 0.28, 0.245), (0.21, 0.18, 0.15)),
)
CHIPS = Family("chip", False, CRUSHED.colours)
SLAG = Family("slag", True, ((0.085, 0.082, 0.086), (0.12, 0.105, 0.095), (0.15, 0.10, 0.072)))


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
) -> None:
    """Drop stones one after another on the relief, each bedded into what already lies there.

    A stone that lands on a slope beyond the angle of repose rolls downhill until it is flatter, so
    heaps keep the look of tipped material. `area` is (xmin, xmax, ymin, ymax) m.
    """
    by_size = sorted(shapes, key=lambda shape: shape.diameter)
    sizes = np.array([shape.diameter for shape in by_size])
    centres = np.array([[k.x, k.y, k.radius, k.above] for k in keep]).reshape(-1, 4)
    for diameter in diameters:
        size = sizes[np.abs(sizes - diameter).argmin()]
        first, last = np.searchsorted(sizes, [0.999 * size, 1.001 * size])
        shape = by_size[int(rng.integers(first, last))]
        place = _place(rng, relief, shape.diameter, area, centres, repose)
        if place is None:
            continue
        x, y = place
        rotation = _lie(rng, relief.slope(x, y, 0.5 * shape.diameter))
        planes = turned(shape.hull.planes, rotation)
        z = relief.bed(planes, x, y, shape.reach, rng.uniform(0.80, 0.94))
        colours = shape.family.colours
        colour = np.array(colours[int(rng.integers(len(colours)))]) * rng.uniform(0.75, 1.2)
        add_mesh_geom(spec, shape.mesh, np.array([x, y, z]), rotation, colour)


def _place(
    rng: np.random.Generator,
    relief: Relief,
    diameter: float,
    area: tuple[float, float, float, float],
    keep: Array,
    repose: float,
) -> tuple[float, float] | None:
    # Loads are tipped in heaps: of two places a stone often takes the higher.
    xs, ys = rng.uniform(area[0], area[1], 2), rng.uniform(area[2], area[3], 2)
    pick = int(np.argmax(relief.at(xs, ys))) if rng.random() < 0.4 else 0
    x, y = float(xs[pick]), float(ys[pick])
    for _ in range(12):
        gradient = relief.slope(x, y, 0.6 * diameter)
        steep = float(np.hypot(*gradient))
        if steep < np.tan(repose):
            break
        x, y = (np.array([x, y]) - 0.5 * diameter * gradient / steep).tolist()
    inside = area[0] <= x <= area[1] and area[2] <= y <= area[3]
    near = np.hypot(keep[:, 0] - x, keep[:, 1] - y) < keep[:, 2] + 0.5 * diameter
    if not inside or (near & (diameter > keep[:, 3])).any():
        return None
    return x, y


def _lie(rng: np.random.Generator, gradient: Array) -> Array:
    """A rotation that lays the flat side on the slope, give or take, with any heading."""
    up = np.array([-gradient[0], -gradient[1], 1.0])
    up = up / np.linalg.norm(up) + rng.normal(scale=0.16, size=3)
    heading = rng.uniform(0.0, 2.0 * np.pi)
    return frame(up, np.array([np.cos(heading), np.sin(heading), 0.0]))


def add_mesh_geom(
    spec: mujoco.MjSpec, mesh: str, position: Array, rotation: Array, colour: Array
) -> None:
    """Place a mesh of the model in the world; colour is linear RGB (3,)."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=mesh,
        pos=position,
        quat=quaternion,
        rgba=[*np.clip(colour, 0.0, 1.0), 1.0],
    )
