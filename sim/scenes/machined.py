"""Machined parts with through, blind and slotted holes, as exact prisms and turned shapes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sim.scenes.arrangement import Colour, Part, Piece, Shelf, pick
from sim.scenes.solids import (
    LYING,
    UPRIGHT,
    Solid,
    arc,
    circle,
    extrude,
    joined,
    polygon,
    rectangle,
    revolve,
    rounded,
)

Array = NDArray[np.float64]

STEEL: tuple[Colour, ...] = ((0.22, 0.225, 0.23), (0.17, 0.175, 0.185), (0.29, 0.29, 0.288))
BLACKENED: Colour = (0.055, 0.057, 0.062)
BRASS: Colour = (0.34, 0.235, 0.075)
ANODISED: tuple[Colour, ...] = ((0.33, 0.335, 0.34), (0.06, 0.11, 0.27), (0.33, 0.06, 0.04))
CAST: tuple[Colour, ...] = ((0.10, 0.19, 0.15), (0.13, 0.17, 0.25), (0.16, 0.165, 0.17))


def _round_of(count: int, radius: float, hole: float, phase: float = 0.0) -> list[Array]:
    angles = phase + 2.0 * np.pi * np.arange(count) / count
    return [circle(hole, (radius * np.cos(a), radius * np.sin(a))) for a in angles]


def flange(rng: np.random.Generator) -> Piece:
    """A pipe flange: a disc with a bolt circle, and a hub around the bore."""
    r = rng.uniform(0.050, 0.085)
    thick, bore = rng.uniform(0.010, 0.016), r * rng.uniform(0.26, 0.36)
    hub, tall = bore + rng.uniform(0.006, 0.012), rng.uniform(0.02, 0.045)
    count = int(rng.choice([4, 6, 8]))
    bolts = _round_of(count, 0.5 * (hub + r) + 0.002, min(0.007, 0.16 * (r - hub) + 0.003))
    disc = extrude(circle(r), thick, [circle(bore), *bolts])
    neck = extrude(circle(hub), tall, [circle(bore)], bottom=thick)
    return Piece("flange", (Part(joined([disc, neck]), pick(rng, STEEL), "steel"),))


def bracket(rng: np.random.Generator) -> Piece:
    """An angle bracket: slotted foot, upright plate with a large hole, two gussets."""
    a, b, tall = rng.uniform(0.035, 0.055), rng.uniform(0.03, 0.045), rng.uniform(0.06, 0.11)
    wall = rng.uniform(0.006, 0.009)
    slots = [rounded(0.012, 0.0035, 0.0035, (s * 0.5 * a, 0.25 * b)) for s in (-1, 1)]
    foot = extrude(rectangle(a, b), wall, slots)
    hole = circle(0.4 * a, (0.0, 0.62 * tall))
    small = [circle(0.003, (s * 0.75 * a, 0.85 * tall)) for s in (-1, 1)]
    plate = extrude(rectangle(a, 0.5 * tall, (0.0, 0.5 * tall)), wall, [hole, *small])
    plate = plate.moved((0.0, -b + wall, wall), UPRIGHT)
    rib = np.array([[0.0, 0.0], [1.1 * b, 0.0], [0.0, 0.55 * tall]])
    parts = [foot, plate]
    for s in (-1.0, 1.0):
        x = s * (a - 0.5 * wall) - 0.25 * wall
        turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        parts.append(extrude(rib, 0.5 * wall).moved((x, -b + wall, wall), turn))
    colour, material = (
        (pick(rng, STEEL), "steel") if rng.random() < 0.5 else (pick(rng, CAST), "painted")
    )
    return Piece("bracket", (Part(joined(parts), colour, material),))


def bearing_block(rng: np.random.Generator) -> Piece:
    """A pillow block: cast housing with a bore, feet with bolt holes, a steel ring in the bore."""
    r, deep = rng.uniform(0.030, 0.042), rng.uniform(0.016, 0.022)
    axis, foot = r + rng.uniform(0.008, 0.014), rng.uniform(0.012, 0.016)
    bore = 0.62 * r
    dome = arc((0.0, axis), r, -0.15, np.pi + 0.15, 97)
    outline = np.concatenate([[[-1.05 * r, 0.0], [1.05 * r, 0.0]], dome])
    housing = extrude(outline, 2.0 * deep, [circle(bore, (0.0, axis))])
    housing = housing.moved((0.0, deep, 0.0), UPRIGHT)
    reach = 0.55 * r
    feet = []
    for s in (-1.0, 1.0):
        x = s * (1.05 * r + reach)
        feet.append(extrude(rounded(reach, deep, 0.003, (x, 0.0)), foot, [circle(0.0045, (x, 0))]))
    ring = extrude(circle(bore), 1.7 * deep, [circle(0.62 * bore)])
    ring = ring.moved((0.0, 0.85 * deep, axis), UPRIGHT)
    return Piece(
        "bearing_block",
        (
            Part(joined([housing, *feet]), pick(rng, CAST), "painted"),
            Part(ring, STEEL[2], "polished"),
        ),
    )


def slotted_plate(rng: np.random.Generator) -> Piece:
    """A milled plate: slots and holes through it, round bosses and a bar on top."""
    a, b, c = rng.uniform(0.07, 0.10), rng.uniform(0.045, 0.065), rng.uniform(0.010, 0.016)
    slots = [rounded(0.35 * a, 0.006, 0.006, (0.35 * a, s * 0.45 * b)) for s in (-1, 1)]
    corners = [
        circle(0.0033, (sx * (a - 0.009), sy * (b - 0.009))) for sx in (-1, 1) for sy in (-1, 1)
    ]
    window = rounded(0.2 * a, 0.3 * b, 0.006, (-0.45 * a, 0.0))
    plate = extrude(rounded(a, b, 0.005), c, [*slots, *corners, window])
    tall = rng.uniform(0.014, 0.03)
    spots = [(-0.45 * a, s * 0.62 * b) for s in (-1, 1)]
    boss = [extrude(circle(0.011, at), tall, [circle(0.004, at)], bottom=c) for at in spots]
    bar = extrude(rectangle(0.5 * a, 0.12 * b, (0.3 * a, 0.0)), 0.6 * tall, bottom=c)
    return Piece(
        "slotted_plate", (Part(joined([plate, *boss, bar]), pick(rng, ANODISED), "steel"),)
    )


def manifold(rng: np.random.Generator) -> Piece:
    """A valve block with blind holes from above, two of them stepped."""
    a, b, tall = rng.uniform(0.045, 0.07), rng.uniform(0.028, 0.036), rng.uniform(0.05, 0.08)
    deep, sink = rng.uniform(0.02, 0.03), rng.uniform(0.005, 0.008)
    xs = a * np.array([-0.62, 0.0, 0.62])
    outline = rectangle(a, b)
    wide = [circle(0.0115, (x, 0.25 * b)) for x in xs]
    narrow = [circle(0.0075, (x, 0.25 * b)) for x in xs]
    taps = [circle(0.0025, (x + s * 0.2 * a, -0.6 * b)) for x in xs for s in (-1, 1)]
    body = [
        extrude(outline, tall - deep),
        extrude(outline, deep - sink, narrow, bottom=tall - deep),
        extrude(outline, sink, wide + taps, bottom=tall - sink),
    ]
    return Piece("manifold", (Part(joined(body), pick(rng, ANODISED), "steel"),))


def gear(rng: np.random.Generator) -> Piece:
    """A spur gear with a keyed bore, lightening holes and a hub."""
    teeth, module = int(rng.integers(20, 34)), rng.uniform(0.0038, 0.0048)
    pitch = 0.5 * teeth * module
    step = 2.0 * np.pi / teeth
    root, tip = pitch - 1.2 * module, pitch + module
    shape = ((root, -0.46), (root, -0.30), (pitch, -0.24), (tip, -0.12), (tip, 0.12),
             (pitch, 0.24), (root, 0.30))  # fmt: skip
    corners = [(r, step * (k + s)) for k in range(teeth) for r, s in shape]
    outline = np.array([[r * np.cos(a), r * np.sin(a)] for r, a in corners])
    bore = 0.2 * pitch
    key = 0.28 * bore
    edge = np.arcsin(key / bore)
    keyway = [[1.3 * bore, -key], [1.3 * bore, key]]
    keyed = np.concatenate([arc((0.0, 0.0), bore, edge, 2.0 * np.pi - edge, 121), keyway])
    thick, hub = rng.uniform(0.010, 0.018), rng.uniform(0.008, 0.016)
    light = _round_of(int(rng.choice([4, 5, 6])), 0.58 * pitch, 0.14 * pitch)
    disc = extrude(outline, thick, [keyed, *light])
    neck = extrude(circle(0.34 * pitch), hub, [keyed], bottom=thick)
    colour = BRASS if rng.random() < 0.3 else pick(rng, STEEL)
    return Piece("gear", (Part(joined([disc, neck]), colour, "steel"),))


def v_block(rng: np.random.Generator) -> Piece:
    """A V-block with a ground pin lying in its groove."""
    a, tall, long = rng.uniform(0.028, 0.038), rng.uniform(0.04, 0.055), rng.uniform(0.035, 0.05)
    vee = 0.62 * a
    outline = np.array(
        [[-a, 0.0], [a, 0.0], [a, tall], [vee, tall], [0.0, tall - vee], [-vee, tall], [-a, tall]]
    )
    block = extrude(outline, 2.0 * long).moved((0.0, long, 0.0), UPRIGHT)
    # The pin touches both flanks along a line: its circle's corners lie a hair outside.
    r = rng.uniform(0.5, 0.75) * vee
    corner = float(np.linalg.norm(circle(r)[0]))
    lift = tall - vee + corner * np.sqrt(2.0)
    length = long * rng.uniform(1.2, 1.6)
    pin = extrude(circle(r), 2.0 * length).moved((0.0, length, lift), UPRIGHT)
    return Piece(
        "v_block",
        (Part(block, STEEL[1], "steel"), Part(pin, STEEL[2], "polished")),
    )


def stepped_shaft(rng: np.random.Generator) -> Piece:
    """A turned shaft lying on its collars."""
    r, long = rng.uniform(0.010, 0.016), rng.uniform(0.07, 0.12)
    big = r * rng.uniform(1.7, 2.1)
    steps = ((0.0, 0.8 * r), (0.16, r), (0.34, big), (0.42, 1.25 * r), (0.72, big), (0.80, 0.9 * r))
    profile = [[0.0, 0.0]]
    ends = [*(z for z, _ in steps[1:]), 1.0]
    for (z, radius), end in zip(steps, ends, strict=True):
        profile += [[radius, 2.0 * long * z], [radius, 2.0 * long * end]]
    profile.append([0.0, 2.0 * long])
    solid = revolve(np.array(profile)).moved((-long, 0.0, 0.0), LYING)
    return Piece("shaft", (Part(solid, pick(rng, STEEL), "polished"),)).settled()


def channel(rng: np.random.Generator) -> Piece:
    """A length of U channel, open upwards, with slots in its web."""
    a, b, tall = rng.uniform(0.08, 0.12), rng.uniform(0.022, 0.03), rng.uniform(0.025, 0.04)
    wall = 0.004
    slots = [rounded(0.011, 0.004, 0.004, (x, 0.0)) for x in np.linspace(-0.75 * a, 0.75 * a, 5)]
    web = extrude(rectangle(a, b), wall, slots)
    holes = [circle(0.004, (x, 0.6 * tall)) for x in np.linspace(-0.8 * a, 0.8 * a, 7)]
    side = extrude(rectangle(a, 0.5 * (tall - wall), (0.0, 0.5 * (tall + wall))), wall, holes)
    sides = [side.moved((0.0, y, 0.0), UPRIGHT) for y in (-b + wall, b)]
    return Piece("channel", (Part(joined([web, *sides]), STEEL[2], "steel"),))


THREADS = (0.012, 0.016, 0.020)
"""Nominal diameters of the nuts and bolts, m."""


@cache
def nut(size: float) -> Piece:
    """A hexagon nut for a thread of `size` m: 1.6 wide across its flats, 0.8 tall."""
    solid = extrude(polygon(0.924 * size, 6), 0.8 * size, [circle(0.5 * size)])
    return Piece("nut", (Part(solid, STEEL[0], "steel"),))


def bolt_shape(size: float, length: float) -> Solid:
    """A hexagon bolt standing on its head, its shank `length` m."""
    head = extrude(polygon(0.924 * size, 6), 0.65 * size)
    shank = revolve(
        np.array([[0.0, 0.0], [0.5 * size, 0.0], [0.5 * size, length - 0.001],
                  [0.5 * size - 0.001, length], [0.0, length]]), 48,
    ).moved((0.0, 0.0, 0.65 * size))  # fmt: skip
    return joined([head, shank])


@cache
def bolt(size: float, length: float) -> Piece:
    """A hexagon bolt lying on head and shank."""
    return (
        Piece("bolt", (Part(bolt_shape(size, length), STEEL[0], "steel"),))
        .moved((0.0, 0.0, 0.0), LYING)
        .settled()
    )


def bush(rng: np.random.Generator) -> Piece:
    """A collared bush standing on its collar."""
    r, tall = rng.uniform(0.014, 0.028), rng.uniform(0.025, 0.05)
    collar = extrude(circle(1.4 * r), 0.25 * r, [circle(0.65 * r)])
    sleeve = extrude(circle(r), tall, [circle(0.65 * r)], bottom=0.25 * r)
    return Piece("bush", (Part(joined([collar, sleeve]), BRASS, "steel"),))


def motor(rng: np.random.Generator) -> Piece:
    """A stepper motor standing on its back: laminated body, flange with holes, shaft."""
    a, tall = rng.uniform(0.028, 0.034), rng.uniform(0.05, 0.08)
    cap = 0.012
    holes = [circle(0.0025, (sx * 0.8 * a, sy * 0.8 * a)) for sx in (-1, 1) for sy in (-1, 1)]
    ends = [
        extrude(rounded(a, a, 0.004), cap),
        extrude(rounded(a, a, 0.004), cap, holes, bottom=tall - cap),
        extrude(circle(0.5 * a), 0.002, bottom=tall),
    ]
    shaft = extrude(circle(0.0035), 0.024, bottom=tall)
    octagon = polygon(1.0, 8)
    core = extrude(np.clip(octagon * 1.35 * a, -0.96 * a, 0.96 * a), tall - 2.0 * cap, bottom=cap)
    return Piece(
        "motor",
        (
            Part(joined(ends), ANODISED[0], "steel"),
            Part(core, BLACKENED, "painted"),
            Part(shaft, STEEL[2], "polished"),
        ),
    )


def block(rng: np.random.Generator) -> Piece:
    """A ground parallel block others can stand on."""
    a, b, tall = rng.uniform(0.05, 0.08), rng.uniform(0.035, 0.05), rng.uniform(0.02, 0.045)
    solid: Solid = extrude(rounded(a, b, 0.002, arc=4), tall)
    return Piece("block", (Part(solid, pick(rng, STEEL), "steel"),), Shelf(a, b, tall))


MACHINED: tuple[Callable[[np.random.Generator], Piece], ...] = (
    flange, bracket, bearing_block, slotted_plate, manifold, gear, v_block, stepped_shaft,
    channel, motor,
)  # fmt: skip
