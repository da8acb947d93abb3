"""The industrial bay: 7 x 6 m of crushed stone, steel slag and scrap, with a work piece on top.

World: x along the gantry's long axis, y along the short one, z up from the floor's level; the
markers lie at the corners (0, 0), (7, 0) and (0, 6) of the bay. The three scenes have the same
floor, and their work pieces the same raked place on it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.engine import mujoco
from sim.scenes.ground import add_ground, make_ground
from sim.scenes.relief import Relief, rest_on_three
from sim.scenes.scrap import RUST, STEEL, add_body, scatter_scrap
from sim.scenes.solids import LYING, Solid
from sim.scenes.stones import (
    CHIPS,
    CRUSHED,
    SLAG,
    Keep,
    add_mesh_geom,
    draw_diameters,
    make_shapes,
    scatter,
)
from sim.scenes.workpieces import Coil, billet, coil, flake, slab, stepped_plate
from sim.seeds import stream

Array = NDArray[np.float64]

BAY = (7.0, 6.0)
"""Length and width of the bay, m."""

MARKERS = {"origin": (0.0, 0.0), "far_x": (7.0, 0.0), "far_y": (0.0, 6.0)}
"""Where the markers lie, m."""

MARKER_RADIUS = 0.025
MARKER_THICKNESS = 0.002

FINISHES = {"steel": (0.8, 0.5), "rust": (0.4, 0.2), "slag": (0.4, 0.25), "wood": (0.2, 0.1)}
"""Specular and shininess of the materials: hot-rolled steel, not machined; glassy slag."""

TIMBER = (0.30, 0.195, 0.105)
SCALE = ((0.105, 0.095, 0.095), (0.13, 0.10, 0.085), (0.085, 0.085, 0.095))
PAINTS = ((0.75, 0.72, 0.65), (0.70, 0.50, 0.06), (0.10, 0.25, 0.50))

# The rubble goes on beyond the bay as far as the outermost frames see.
_AREA = (-1.5, 8.5, -1.2, 7.2)
_STREWN = (-1.3, 8.3, -1.0, 7.0)
_SPACING = 0.025


class Floor(NamedTuple):
    """The floor as it was strewn, and the raked place on it for a work piece."""

    relief: Relief
    x: float
    y: float
    yaw: float

    def beside(self, along: float, across: float) -> tuple[float, float]:
        """World x, y of a place given from the raked place's centre along and across its yaw, m."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        return self.x + cos * along - sin * across, self.y + sin * along + cos * across


def industrial_4(seed: int) -> mujoco.MjSpec:
    """A steel slab, and billets beside it, across each other and leaning on it."""
    spec, floor = _bay("industrial-4", seed)
    rng = stream(seed, "industrial-4", "slab")
    # Steel on steel touches at edges, which the floor's raster would miss.
    floor = floor._replace(relief=floor.relief.finer(floor.x, floor.y, 2.0, 0.006))
    piece = slab(rng)
    middle = rng.uniform(-0.45, -0.35)
    x, y = floor.beside(0.0, middle)
    rotation, position = rest_on_three(floor.relief, x, y, floor.yaw, piece.half[:2], pressed=1.0)
    shade = np.array(STEEL[1]) * rng.uniform(0.9, 1.1)
    add_body(spec, floor.relief, piece, rotation, position, [shade], "steel", "slab")
    for number in range(9):
        along, across = rng.uniform(-0.85, 0.85, 2) * piece.half[:2]
        at = position + rotation @ [along, across, 2.0 * piece.half[2]]
        rust = np.array(RUST[number % len(RUST)]) * rng.uniform(0.5, 0.8)
        name = f"scale_{number}"
        _add_mesh(spec, name, flake(rng))
        add_mesh_geom(spec, name, at, rotation, rust, name, "rust")
    _stack_billets(spec, floor, middle + piece.half[1], rng)
    _shake_chips_onto(spec, floor, rng)
    return spec


def _stack_billets(
    spec: mujoco.MjSpec, floor: Floor, edge: float, rng: np.random.Generator
) -> None:
    """Three billets beside the slab's edge, one across them, one with an end up on the slab."""
    section, end = rng.uniform(0.12, 0.16), rng.choice([-1.0, 1.0])
    lying = edge + 0.34 + (section + 0.09) * np.arange(3)
    bars = [  # along, across, turn, length, share of the gap below that it is pressed in
        (0.35 * end + rng.uniform(-0.1, 0.1), y, rng.normal(scale=0.015), (1.2, 1.5), 0.5)
        for y in lying
    ]
    bars.append((0.4 * end, lying[1] + 0.1, 1.571 + rng.uniform(-0.3, 0.3), (1.2, 1.35), 0.0))
    bars.append((-0.7 * end, edge + 0.1, 1.571 + rng.uniform(-0.12, 0.12), (1.6, 2.0), 0.0))
    paint = np.array(PAINTS[int(rng.integers(len(PAINTS)))])
    for number, (along, across, turn, length, pressed) in enumerate(bars):
        bar = billet(section, rng.uniform(*length))
        x, y = floor.beside(along, float(across))
        rotation, position = rest_on_three(
            floor.relief, x, y, floor.yaw + turn, bar.half[:2], pressed
        )
        colours = [np.array(SCALE[number % len(SCALE)]) * rng.uniform(0.8, 1.2), paint, paint]
        name = f"billet_{number}"
        add_body(spec, floor.relief, bar, rotation, position, colours, "steel", name)


def industrial_5(seed: int) -> mujoco.MjSpec:
    """A steel coil on its side, chocked by two timbers."""
    spec, floor = _bay("industrial-5", seed)
    rng = stream(seed, "industrial-5", "coil")
    _add_coil(spec, floor, coil(rng), rng)
    return spec


def industrial_6(seed: int) -> mujoco.MjSpec:
    """A medium-thick plate with several planes, bedded in the rubble."""
    spec, floor = _bay("industrial-6", seed)
    plate = stepped_plate(stream(seed, "industrial-6", "plate"))
    rotation, position = rest_on_three(
        floor.relief, floor.x, floor.y, floor.yaw, plate.half[:2], pressed=1.0
    )
    colours = [np.array(STEEL[k % len(STEEL)]) for k in range(len(plate.parts))]
    add_body(spec, floor.relief, plate, rotation, position, colours, "steel", "plate")
    _shake_chips_onto(spec, floor, stream(seed, "industrial-6", "on-plate"))
    return spec


def _shake_chips_onto(spec: mujoco.MjSpec, floor: Floor, rng: np.random.Generator) -> None:
    """The few stones that loading left on a flat work piece."""
    few = make_shapes(spec, rng, CHIPS, np.array([0.06, 0.09]), 3)
    around = (floor.x - 0.5, floor.x + 0.5, floor.y - 0.5, floor.y + 0.5)
    diameters = draw_diameters(rng, 10, 0.05, 0.1, 2.0)
    scatter(spec, rng, floor.relief, few, diameters, around, name="chip")


def _add_coil(spec: mujoco.MjSpec, floor: Floor, piece: Coil, rng: np.random.Generator) -> None:
    rotation, position = rest_on_three(
        floor.relief, floor.x, floor.y, floor.yaw, piece.timbers.half[:2], pressed=1.0
    )
    colours = [np.array(TIMBER) * rng.uniform(0.7, 1.1) for _ in piece.timbers.parts]
    add_body(spec, floor.relief, piece.timbers, rotation, position, colours, "wood", "timber")
    centre = position + piece.centre * rotation[:, 2]
    _add_mesh(spec, "coil", piece.strip)
    _add_mesh(spec, "strap", piece.strap)
    lying = rotation @ LYING
    shade = np.array(STEEL[2]) * rng.uniform(0.9, 1.2)
    add_mesh_geom(spec, "coil", centre, lying, shade, "coil_0", "steel")
    for number, along in enumerate(piece.straps):
        at = centre + along * rotation[:, 0]
        add_mesh_geom(spec, "strap", at, lying, np.array(STEEL[1]), f"strap_{number}", "steel")


def _add_mesh(spec: mujoco.MjSpec, name: str, solid: Solid) -> None:
    spec.add_mesh(
        name=name, uservert=solid.vertices.ravel(), userface=solid.faces.astype(int).ravel()
    )


def _bay(name: str, seed: int) -> tuple[mujoco.MjSpec, Floor]:
    """The floor that all industrial scenes share: fines, stones, slag, scrap and the markers."""
    spec = mujoco.MjSpec()
    spec.modelname = name
    for finish, (specular, shininess) in FINISHES.items():
        spec.add_material(name=finish, specular=specular, shininess=shininess)
    place = stream(seed, "bay", "place")
    x, y = place.uniform(2.9, 4.1), place.uniform(2.5, 3.5)
    yaw = place.uniform(0.0, 2.0 * np.pi)
    # It was raked, with no stone left on which a work piece would hang in the air.
    raked = (Keep(x, y, 1.3, above=0.07),)
    clear = tuple(Keep(mx, my, 0.10, above=0.0) for mx, my in MARKERS.values())
    # Taller stones stay farther off, so that every frame sees the whole disc.
    wide = tuple(Keep(mx, my, 0.35, above=0.12) for mx, my in MARKERS.values())
    level = tuple(Keep(mx, my, 0.06) for mx, my in MARKERS.values())
    relief = make_ground(stream(seed, "bay", "ground"), _AREA, _SPACING, level + raked)
    add_ground(spec, relief, (0.15, 0.135, 0.117))

    rng = stream(seed, "bay", "stones")
    sizes = np.geomspace(0.05, 0.40, 14)
    shapes = make_shapes(spec, rng, CRUSHED, sizes, 8)
    lumps = make_shapes(spec, rng, SLAG, sizes[:-2], 4)
    shapes = shapes + lumps
    diameters = draw_diameters(rng, 1300, 0.05, 0.34, 2.0)
    large = diameters > 0.18
    everywhere = clear + wide + raked
    off = tuple(Keep(k.x, k.y, k.radius + 0.25) for k in clear + raked)
    scatter_scrap(spec, stream(seed, "bay", "scrap"), relief, 36, _STREWN, off)
    scatter(spec, rng, relief, shapes, diameters[large], _STREWN, everywhere, name="boulder")
    scatter(spec, rng, relief, shapes, diameters[~large], _STREWN, everywhere, name="stone")

    for marker, (mx, my) in MARKERS.items():
        half = 0.5 * MARKER_THICKNESS
        spec.worldbody.add_geom(
            name=f"marker_{marker}",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[MARKER_RADIUS, half, 0.0],
            pos=[mx, my, float(relief.at(mx, my)) + half],
            rgba=[0.85, 0.85, 0.80, 1.0],
        )
    return spec, Floor(relief, x, y, yaw)
