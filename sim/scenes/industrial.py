"""The industrial bay: 7 x 6 m of crushed stone, steel slag and scrap, with a workpiece on top.

World: x along the gantry's long axis, y along the short one, z up from the floor's level; the
markers lie at the corners (0, 0), (7, 0) and (0, 6) of the bay.
"""

from __future__ import annotations

import numpy as np

from sim.engine import mujoco
from sim.scenes.ground import add_ground, make_ground
from sim.scenes.relief import Relief, rest_on_three
from sim.scenes.scrap import STEEL, add_body, scatter_scrap
from sim.scenes.stones import CHIPS, CRUSHED, SLAG, Keep, draw_diameters, make_shapes, scatter
from sim.scenes.workpieces import stepped_plate
from sim.seeds import stream

BAY = (7.0, 6.0)
"""Length and width of the bay, m."""

MARKERS = {"origin": (0.0, 0.0), "far_x": (7.0, 0.0), "far_y": (0.0, 6.0)}
"""Where the markers lie, m."""

MARKER_RADIUS = 0.025
MARKER_THICKNESS = 0.002

# The rubble goes on beyond the bay as far as the outermost frames see.
_AREA = (-1.5, 8.5, -1.2, 7.2)
_STREWN = (-1.3, 8.3, -1.0, 7.0)
_SPACING = 0.025


def industrial_6(seed: int) -> mujoco.MjSpec:
    """A medium-thick plate with several planes, bedded in the rubble."""
    spec = mujoco.MjSpec()
    spec.modelname = "industrial-6"
    place = stream(seed, "industrial-6", "plate")
    x, y = place.uniform(2.9, 4.1), place.uniform(2.5, 3.5)
    yaw = place.uniform(0.0, 2.0 * np.pi)
    plate = stepped_plate(place)
    # Its place was raked, with no stone left on which it would hang in the air.
    relief = _rubble(spec, seed, "industrial-6", (Keep(x, y, 1.3, above=0.07),))
    rotation, position = rest_on_three(relief, x, y, yaw, plate.half[:2], pressed=1.0)
    colours = [np.array(STEEL[k % len(STEEL)]) for k in range(len(plate.parts))]
    add_body(spec, relief, plate, rotation, position, colours, name="plate")
    # Loading shook some stones onto it.
    rng = stream(seed, "industrial-6", "on-plate")
    few = make_shapes(spec, rng, CHIPS, np.array([0.06, 0.09]), 3)
    scatter(
        spec, rng, relief, few, draw_diameters(rng, 10, 0.05, 0.1, 2.0),
        (x - 0.5, x + 0.5, y - 0.5, y + 0.5),
    )  # fmt: skip
    return spec


def _rubble(spec: mujoco.MjSpec, seed: int, scene: str, keep: tuple[Keep, ...] = ()) -> Relief:
    """The floor that all industrial scenes share: fines, stones, slag, scrap and the markers."""
    clear = tuple(Keep(x, y, 0.10, above=0.0) for x, y in MARKERS.values())
    # Taller stones stay farther off, so that every frame sees the whole disc.
    wide = tuple(Keep(x, y, 0.35, above=0.12) for x, y in MARKERS.values())
    level = tuple(Keep(x, y, 0.06) for x, y in MARKERS.values())
    relief = make_ground(stream(seed, scene, "ground"), _AREA, _SPACING, level + keep)
    add_ground(spec, relief, (0.15, 0.135, 0.117))

    rng = stream(seed, scene, "stones")
    sizes = np.geomspace(0.05, 0.40, 14)
    shapes = make_shapes(spec, rng, CRUSHED, sizes, 8)
    lumps = make_shapes(spec, rng, SLAG, sizes[:-2], 4)
    shapes = shapes + lumps
    diameters = draw_diameters(rng, 1300, 0.05, 0.34, 1.7)
    large = diameters > 0.18
    everywhere = clear + wide + keep
    scrap = stream(seed, scene, "scrap")
    off = tuple(Keep(k.x, k.y, k.radius + 0.25) for k in clear + keep)
    scatter_scrap(spec, scrap, relief, 36, _STREWN, off)
    scatter(spec, rng, relief, shapes, diameters[large], _STREWN, everywhere)
    scatter(spec, rng, relief, shapes, diameters[~large], _STREWN, everywhere)

    for name, (x, y) in MARKERS.items():
        half = 0.5 * MARKER_THICKNESS
        spec.worldbody.add_geom(
            name=f"marker_{name}",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[MARKER_RADIUS, half, 0.0],
            pos=[x, y, float(relief.at(x, y)) + half],
            rgba=[0.85, 0.85, 0.80, 1.0],
        )
    return relief
