"""The large steel pieces that stand in the industrial bay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.scenes.scrap import CYLINDER, Body, Part, box
from sim.scenes.solids import Solid, extrude, revolve

Array = NDArray[np.float64]


def stepped_plate(rng: np.random.Generator) -> Body:
    """A medium-thick plate: two plates welded on in steps, a bent-up end, a rib, two bosses."""
    a, b, c = rng.uniform(0.95, 1.1), rng.uniform(0.58, 0.68), rng.uniform(0.012, 0.016)
    a1, b1, c1 = rng.uniform(0.45, 0.55), rng.uniform(0.36, 0.44), rng.uniform(0.006, 0.010)
    a2, b2, c2 = rng.uniform(0.2, 0.26), rng.uniform(0.16, 0.22), rng.uniform(0.008, 0.012)
    x1, y1 = rng.uniform(-0.25, -0.1), rng.uniform(-0.1, 0.1)
    top, step = 2.0 * c, 2.0 * (c + c1)
    bend, wing = np.radians(rng.uniform(3.0, 5.0)), rng.uniform(0.14, 0.2)
    wing_at = (a + np.cos(bend) * wing, 0.0, c + np.sin(bend) * wing)
    parts = (
        box((a, b, c), (0.0, 0.0, c)),
        box((a1, b1, c1), (x1, y1, top + c1)),
        box((a2, b2, c2), (x1 - 0.12, y1 + 0.08, step + c2)),
        box((wing, b, c), wing_at, tilt=-bend),
        box((0.012, 0.8 * b, 0.015), (a - 0.22, 0.0, top + 0.015)),
        Part(CYLINDER, (0.075, 0.012), (0.55 * a, -0.6 * b, top + 0.012)),
        Part(CYLINDER, (0.075, 0.012), (0.55 * a, 0.6 * b, top + 0.012)),
    )
    return Body(parts, (a, b, c))


def slab(rng: np.random.Generator) -> Body:
    """A cast slab."""
    half = rng.uniform(0.9, 1.1), rng.uniform(0.45, 0.55), rng.uniform(0.09, 0.125)
    return Body((box(half, (0.0, 0.0, half[2])),), half)


def flake(rng: np.random.Generator) -> Solid:
    """A patch of scale, a millimetre or two thick, on z = 0."""
    count = int(rng.integers(9, 16))
    angle = 2.0 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    radius = rng.uniform(0.04, 0.13) * rng.uniform(0.6, 1.2, count)
    outline = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    return extrude(outline, rng.uniform(0.0008, 0.002))


def billet(section: float, length: float) -> Body:
    """A square bar with painted ends; `section` is its side, m."""
    a, b, paint = 0.5 * length, 0.5 * section, 0.0005
    ends = (box((paint, b, b), (side * (a - paint), 0.0, b)) for side in (-1.0, 1.0))
    return Body((box((a - 2.0 * paint, b, b), (0.0, 0.0, b)), *ends), (a, b, b))


@dataclass(frozen=True)
class Coil:
    """Wound strip on its side, between two timbers; axis along x, z = 0 the timbers' underside."""

    strip: Solid
    """Its turns, which stand out by a few millimetres at the ends."""
    strap: Solid
    """A band around it, across the middle of the strip."""
    straps: tuple[float, ...]
    """Where along the axis the bands are, m."""
    centre: float
    """Height of the axis, m."""
    timbers: Body
    """The two timbers, in whose inner edges it lies."""


def coil(rng: np.random.Generator) -> Coil:
    """A coil 0.9 to 1.3 m thick and 0.8 to 1.1 m wide with a bore of half a metre."""
    radius, bore = rng.uniform(0.45, 0.65), rng.uniform(0.25, 0.26)
    half, turns = rng.uniform(0.4, 0.55), 11
    # What one sees of a wound strip from the end: rings that stand out more or less.
    rings = np.linspace(bore, radius, turns + 1)
    out = half + rng.uniform(-0.02, 0.0, (2, turns))
    out[:, -1] = half
    low = np.column_stack([np.repeat(rings, 2)[1:-1], -np.repeat(out[0], 2)])
    high = np.column_stack([np.repeat(rings, 2)[1:-1], np.repeat(out[1], 2)])[::-1]
    strip = revolve(np.concatenate([low, high]), SEGMENTS)
    thick, broad = 0.001, 0.016
    outside, inside = radius + thick, radius - 0.005
    band = [(inside, -broad), (outside, -broad), (outside, broad), (inside, broad)]
    # It touches neither the ground nor the timbers' tops, only their inner edges.
    timber, clear = rng.uniform(0.07, 0.08), 0.045
    centre = radius + clear
    gap = float(np.sqrt(radius**2 - (centre - 2.0 * timber) ** 2))
    long = half + rng.uniform(0.12, 0.2)
    size = long, timber, timber
    beams = tuple(box(size, (0.0, side * (gap + timber), timber)) for side in (-1.0, 1.0))
    return Coil(
        strip,
        revolve(np.array(band), SEGMENTS),
        (-0.6 * half, 0.05 * half, 0.6 * half),
        centre,
        Body(beams, (long, gap + 2.0 * timber, timber)),
    )


SEGMENTS = 512
"""Of a coil: its sides fall short of the cylinder, and its corners stand out, by 6 micrometres."""
