"""Hand tools and boxes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim.scenes.arrangement import Colour, Part, Piece, Shelf, pick
from sim.scenes.solids import (
    LYING,
    about,
    arc,
    circle,
    curve,
    extrude,
    joined,
    polygon,
    rectangle,
    revolve,
    rounded,
    tube,
)

CHROME: Colour = (0.36, 0.36, 0.37)
DARK_STEEL: Colour = (0.13, 0.132, 0.138)
BLACK: Colour = (0.030, 0.030, 0.031)
RED: Colour = (0.34, 0.03, 0.022)
YELLOW: Colour = (0.45, 0.27, 0.025)
BLUE: Colour = (0.03, 0.10, 0.32)
GREEN: Colour = (0.05, 0.22, 0.09)
ASH: Colour = (0.40, 0.28, 0.15)
CARDBOARD: tuple[Colour, ...] = ((0.30, 0.20, 0.115), (0.26, 0.17, 0.095), (0.34, 0.235, 0.14))
GRIPS = (RED, YELLOW, BLUE, GREEN)


def hammer(rng: np.random.Generator) -> Piece:
    """A fitter's hammer lying on its side: head with face and peen, ash handle."""
    long, a, w = rng.uniform(0.25, 0.31), rng.uniform(0.045, 0.055), rng.uniform(0.013, 0.016)
    outline = np.array(
        [[-a, -w], [0.35 * a, -w], [0.95 * a, -0.15 * w], [a, 0.15 * w], [0.35 * a, w], [-a, w]]
    )
    head = extrude(outline, 2.0 * w, bottom=-w)
    grip = curve(
        [(0.010, 0.0), (0.010, 0.04), (0.016, 0.1), (0.013, 0.5), (0.010, 0.8), (0.010, 1.0)], 0.02
    )
    z = grip[:, 1] * long
    path = np.column_stack([np.zeros_like(z), w - z - 0.0, np.zeros_like(z)])[::-1]
    handle = tube(path, grip[::-1, 0] * 1.15, 48, flat=0.7)
    return Piece("hammer", (Part(head, DARK_STEEL, "steel"), Part(handle, ASH, "wood"))).settled()


def spanner(rng: np.random.Generator) -> Piece:
    """A combination spanner: open jaw at one end, ring at the other."""
    size = rng.uniform(0.017, 0.026)
    long, thick = 8.5 * size, 0.36 * size
    jaw = 1.15 * size
    tilt = np.radians(15.0)
    cheek = arc((0.0, 0.0), jaw, 0.45 + tilt, 2.0 * np.pi - 0.45 + tilt, 81)
    turn = about(2, tilt)[:2, :2]
    mouth = np.array([[-0.35 * size, -0.5 * size], [-0.35 * size, 0.5 * size]]) @ turn.T
    tips = np.array([[1.03 * size, -0.5 * size], [1.03 * size, 0.5 * size]]) @ turn.T
    open_end = np.concatenate([cheek, tips[:1], mouth, tips[1:]])
    ring = extrude(circle(0.85 * size, (-long, 0.0)), 1.3 * thick,
                   [polygon(0.56 * size, 12, (-long, 0.0))])  # fmt: skip
    start, end = -long + 0.75 * size, -0.8 * size
    shaft = extrude(
        rounded(0.5 * (end - start), 0.34 * size, 0.002, (0.5 * (start + end), 0.0)), 0.8 * thick
    )
    solid = joined([extrude(open_end, thick), shaft, ring]).moved((0.5 * long, 0.0, 0.0))
    return Piece("spanner", (Part(solid, CHROME, "polished"),))


def screwdriver(rng: np.random.Generator) -> Piece:
    """A screwdriver lying on its fluted grip and its tip."""
    long, r = rng.uniform(0.10, 0.15), rng.uniform(0.013, 0.017)
    body = revolve(
        np.concatenate([
            [[0.0, 0.0]],
            curve([(0.5 * r, 0.0), (r, 0.004), (1.05 * r, 0.03), (r, 0.06), (0.6 * r, 0.075),
                   (0.85 * r, 0.095)]),
            [[0.4 * r, 0.1], [0.0, 0.1]],
        ]), 96,
    )  # fmt: skip
    angle = np.arctan2(body.vertices[:, 1], body.vertices[:, 0])
    flute = (1.0 + 0.05 * np.cos(6.0 * angle))[:, None] * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]
    body = body._replace(vertices=body.vertices * flute)
    blade = revolve(
        np.array([[0.0, 0.1], [0.0032, 0.1], [0.0032, 0.1 + long], [0.0, 0.1 + long]]), 48
    )
    tip = extrude(rectangle(0.0045, 0.0007), 0.012, bottom=0.098 + long)
    colour = pick(rng, GRIPS)
    lie = LYING
    middle = (-0.5 * (0.1 + long), 0.0, 0.0)
    return Piece(
        "screwdriver",
        (
            Part(body.moved(middle, lie), colour, "plastic"),
            Part(joined([blade, tip]).moved(middle, lie), CHROME, "polished"),
        ),
    ).settled()


def calipers(rng: np.random.Generator) -> Piece:
    """Vernier calipers lying flat, opened a little."""
    gap = rng.uniform(0.01, 0.05)
    beam = extrude(rectangle(0.105, 0.008, (0.075, 0.0)), 0.0035, bottom=0.002)
    fixed = np.array(
        [[-0.030, -0.008], [0.0, -0.045], [0.0, 0.022], [-0.006, 0.010], [-0.030, 0.008]]
    )
    slide = np.array(
        [
            [0.0, -0.045],
            [0.022, -0.013],
            [0.055, -0.013],
            [0.055, 0.011],
            [0.012, 0.011],
            [0.0, 0.022],
        ]
    )
    jaws = [extrude(fixed, 0.0075), extrude(slide + np.array([gap + 0.0005, 0.0]), 0.0075)]
    knob = extrude(circle(0.005, (gap + 0.045, 0.013)), 0.0075)
    return Piece(
        "calipers", (Part(joined([beam, *jaws, knob]).moved((-0.07, 0, 0)), CHROME, "steel"),)
    )


def pliers(rng: np.random.Generator) -> Piece:
    """Pliers lying flat: two jaws around a pin, dipped grips."""
    spread = rng.uniform(0.10, 0.2)
    grips, steel = [], []
    for s in (-1.0, 1.0):
        jaw = np.array(
            [[-0.004, -0.010], [0.010, -0.0105], [0.048, -0.0045], [0.052, -0.0005], [-0.004, 0.0]]
        )
        jaw = jaw if s < 0 else (jaw * [1.0, -1.0])[::-1]
        steel.append(extrude(jaw, 0.010, bottom=0.0015))
        arm = curve(
            [(-0.004, -s * 0.004), (-0.03, s * 0.010), (-0.06, s * (0.02 + 0.1 * spread)),
             (-0.15, s * (0.014 + 0.1 * spread))], 0.004,
        )  # fmt: skip
        path = np.column_stack([arm, np.full(len(arm), 0.0065)])
        first = int(0.2 * len(arm))
        steel.append(tube(path[: first + 2], 0.0055, 24))
        grips.append(tube(path[first:], 0.0065, 32))
    steel.append(extrude(circle(0.012), 0.011, bottom=0.001))
    steel.append(extrude(circle(0.004), 0.013))
    colour = pick(rng, GRIPS)
    return Piece(
        "pliers", (Part(joined(steel), DARK_STEEL, "steel"), Part(joined(grips), colour, "rubber"))
    ).settled()


def hex_key(rng: np.random.Generator) -> Piece:
    """A hexagon key: an L of six-sided bar lying flat."""
    width = rng.uniform(0.005, 0.009)
    a, b, bend = 14.0 * width, 5.0 * width, 1.6 * width
    elbow = arc((bend, bend), bend, -0.5 * np.pi, -np.pi, 9)
    path = np.concatenate([np.linspace((a, 0.0), (bend + 0.001, 0.0), 4), elbow,
                           np.linspace((0.0, bend + 0.001), (0.0, b), 4)])  # fmt: skip
    bar = tube(np.column_stack([path, np.zeros(len(path))]), 0.577 * width, 6)
    piece = Piece("hex_key", (Part(bar.moved((-0.4 * a, 0.0, 0.0)), BLACK, "painted"),))
    return piece.settled()


def tape_roll(rng: np.random.Generator) -> Piece:
    """A roll of tape lying on its side."""
    r, wide = rng.uniform(0.045, 0.06), rng.uniform(0.022, 0.045)
    tape = extrude(circle(r), wide, [circle(0.66 * r)])
    core = extrude(circle(0.66 * r), wide, [circle(0.62 * r)])
    colour = (0.42, 0.40, 0.34) if rng.random() < 0.5 else pick(rng, GRIPS)
    return Piece("tape", (Part(tape, colour, "plastic"), Part(core, CARDBOARD[0], "matt")))


def carton(rng: np.random.Generator) -> Piece:
    """A closed cardboard box with a strip of tape over its lid."""
    a, b, tall = rng.uniform(0.06, 0.11), rng.uniform(0.045, 0.08), rng.uniform(0.06, 0.18)
    body = extrude(rectangle(a, b), tall)
    strip = extrude(rectangle(a, 0.02), 0.00008, bottom=tall)
    label = extrude(rectangle(0.35 * a, 0.2 * b, (0.45 * a, 0.62 * b)), 0.00008, bottom=tall)
    return Piece(
        "carton",
        (
            Part(body, pick(rng, CARDBOARD), "matt"),
            Part(strip, (0.27, 0.19, 0.10), "plastic"),
            Part(label, (0.55, 0.55, 0.53), "matt"),
        ),
        Shelf(a, b, tall + 0.00008),
    )


def crate(rng: np.random.Generator) -> Piece:
    """An open box of boards on a floor, empty inside."""
    a, b, tall = rng.uniform(0.085, 0.12), rng.uniform(0.06, 0.085), rng.uniform(0.05, 0.09)
    wall = 0.006
    floor = extrude(rectangle(a, b), wall)
    walls = [
        extrude(rectangle(a, 0.5 * wall, (0.0, s * (b - 0.5 * wall))), tall, bottom=wall)
        for s in (-1, 1)
    ] + [
        extrude(rectangle(0.5 * wall, b - wall, (s * (a - 0.5 * wall), 0.0)), tall, bottom=wall)
        for s in (-1, 1)
    ]
    inside = Shelf(a - wall, b - wall, wall)
    if rng.random() < 0.5:
        colour, material = ASH, "wood"
    else:
        colour, material = pick(rng, GRIPS), "plastic"
    return Piece("crate", (Part(joined([floor, *walls]), colour, material),), inside)


def toolbox(rng: np.random.Generator) -> Piece:
    """A small tool box with a ridged lid, a handle and two latches."""
    a, b, tall = rng.uniform(0.10, 0.13), rng.uniform(0.055, 0.07), rng.uniform(0.08, 0.11)
    lid = tall + 0.022
    shell = [
        extrude(rounded(a, b, 0.006), tall),
        extrude(rounded(1.02 * a, 1.04 * b, 0.008), 0.022, bottom=tall),
    ]
    arch = arc((0.0, 0.0), 1.0, 0.0, np.pi, 33) * [0.5 * a, 0.035]
    path = np.column_stack([arch[:, 0], np.zeros(33), lid - 0.004 + arch[:, 1]])
    front = -1.04 * b - 0.003
    spots = [(s * 0.6 * a, front) for s in (-1, 1)]
    latches = [extrude(rectangle(0.012, 0.003, at), 0.03, bottom=tall - 0.014) for at in spots]
    return Piece(
        "toolbox",
        (
            Part(joined(shell), pick(rng, GRIPS), "painted"),
            Part(tube(path, 0.005, 32), BLACK, "plastic"),
            Part(joined(latches), CHROME, "polished"),
        ),
    )


TOOLS: tuple[Callable[[np.random.Generator], Piece], ...] = (
    hammer, spanner, screwdriver, calipers, pliers, hex_key, tape_roll,
)  # fmt: skip
