"""Panels of equal parts at an even pitch: racks, grids, rows on a board, trays.

A panel is a list of pieces and their poses in the panel's frame, within `PANEL` of its origin. Its
pitch looks the same from one part to the next; a gap here and there and the slight unevenness of
hand-set parts are all that tells one place from another.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim.scenes.arrangement import Colour, Part, Piece, Pose, drop, pick
from sim.scenes.crockery import vessel
from sim.scenes.machined import ANODISED, STEEL, bolt_shape, bracket, nut
from sim.scenes.solids import (
    UPRIGHT,
    about,
    arc,
    circle,
    curve,
    extrude,
    joined,
    rectangle,
    revolve,
    rounded,
    sheet,
)

Array = NDArray[np.float64]
Panel = list[tuple[Piece, Pose]]

PANEL = (0.136, 0.142)
"""Half lengths a panel keeps to, m."""

MISSING = 0.09
"""Share of the places that are empty."""

JITTER = 0.0003
"""Standard deviation of a part's place along x and y, m; its heading's is 0.6 degrees."""

_PAINTS: tuple[Colour, ...] = (
    (0.30, 0.05, 0.04), (0.05, 0.10, 0.27), (0.07, 0.20, 0.09), (0.38, 0.25, 0.04)
)  # fmt: skip


def _grid(columns: int, rows: int, pitch: float) -> Array:
    """The places (n, 2) of an even grid around the origin, m."""
    x, y = np.meshgrid(
        (np.arange(columns) - 0.5 * (columns - 1)) * pitch,
        (np.arange(rows) - 0.5 * (rows - 1)) * pitch,
    )
    return np.column_stack([x.ravel(), y.ravel()])


def _set_out(
    rng: np.random.Generator, piece: Piece, places: Array, z: float = 0.0, jitter: float = JITTER
) -> Panel:
    """A piece at most of the places; one at least stays empty."""
    present = rng.random(len(places)) >= MISSING
    present[int(rng.integers(len(places)))] = False
    shift = np.clip(rng.normal(size=(len(places), 2)), -2.0, 2.0) * jitter
    yaw = np.radians(0.6) * np.clip(rng.normal(size=len(places)), -2.0, 2.0)
    return [
        (piece, Pose(float(x), float(y), z, float(a)))
        for (x, y), a, there in zip(places + shift, yaw, present, strict=True)
        if there
    ]


def tube_rack(rng: np.random.Generator) -> Panel:
    """Test tubes in a rack: they hang through the holes of its deck and stand on its floor."""
    pitch, r = rng.uniform(0.031, 0.034), rng.uniform(0.0095, 0.0105)
    tall, deck, wall = rng.uniform(0.12, 0.15), 0.07, 0.005
    columns, rows = 7, 7
    places = _grid(columns, rows, pitch)
    a, b = 0.5 * columns * pitch + 0.004, 0.5 * rows * pitch + 0.004
    holes = [circle(r + 0.0012, place, 64) for place in places]
    side = rectangle(0.5 * wall, b)
    rack = [
        extrude(rectangle(a, b), wall),
        extrude(rounded(a, b, 0.004), wall, holes, bottom=deck),
        *(
            extrude(side + np.array([s * (a - 0.5 * wall), 0.0]), deck - wall, bottom=wall)
            for s in (-1, 1)
        ),
    ]
    bottom = arc((0.0, r), r, -0.5 * np.pi, 0.0, 10)
    bottom[0, 0] = 0.0
    rim = [[r, tall - 0.002], [r + 0.0006, tall - 0.001], [r + 0.0006, tall], [r - 0.001, tall]]
    bore = [[r - 0.001, 0.7 * tall], [0.0, 0.7 * tall]]
    tube = revolve(np.concatenate([bottom, rim, bore]), 56)
    colour = pick(rng, _PAINTS)
    return [
        (Piece("rack", (Part(joined(rack), colour, "plastic"),)), Pose(0.0, 0.0)),
        *_set_out(
            rng, Piece("test_tube", (Part(tube, (0.36, 0.37, 0.37), "polished"),)), places, wall
        ),
    ]


def cubes(rng: np.random.Generator) -> Panel:
    """Equal blocks in rows and columns."""
    pitch, count = (0.052, 5) if rng.random() < 0.5 else (0.043, 6)
    half, tall = 0.31 * pitch, pitch * rng.uniform(0.6, 1.1)
    solid = extrude(rounded(half, half, 0.0015, arc=4), tall, [circle(0.4 * half)])
    piece = Piece("cube", (Part(solid, pick(rng, _PAINTS), "painted"),))
    return _set_out(rng, piece, _grid(count, count, pitch))


def nut_board(rng: np.random.Generator) -> Panel:
    """Nuts lying on a pegboard, each over a hole."""
    pitch, size = 0.026, 0.014
    holes = [circle(0.003, place, 48) for place in _grid(9, 9, pitch)]
    solid = extrude(rounded(0.13, 0.13, 0.006), 0.008, holes)
    board = Piece("pegboard", (Part(solid, (0.24, 0.15, 0.08), "wood"),))
    # They were laid flat to flat, row by row.
    turned = nut(size).moved((0.0, 0.0, 0.0), about(2, np.pi / 6.0))
    rows = _set_out(rng, turned, _grid(9, 5, pitch) * [1.0, 2.0], 0.008)
    return [(board, Pose(0.0, 0.0)), *rows]


def egg_tray(rng: np.random.Generator) -> Panel:
    """Eggs in a moulded tray."""
    pitch, columns, rows = 0.047, 5, 5
    half_x, half_y = 0.5 * columns * pitch, 0.5 * rows * pitch
    y, x = np.meshgrid(
        np.linspace(-half_y, half_y, 18 * rows + 1), np.linspace(-half_x, half_x, 18 * columns + 1),
        indexing="ij",
    )  # fmt: skip
    wave = 2.0 * np.pi / pitch
    # Odd counts: a pocket is at the origin.
    height = 0.022 - 0.0085 * (np.cos(wave * x) + np.cos(wave * y))
    tray = sheet(height, half_x, half_y)
    r = rng.uniform(0.0205, 0.0215)
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 27)
    # Blunt below, pointed above.
    taper = 1.0 - 0.11 * np.sin(angle)
    egg_profile = np.column_stack([r * np.cos(angle) * taper, 1.32 * r * (1.0 + np.sin(angle))])
    egg_profile[[0, -1], 0] = 0.0
    colour = pick(rng, ((0.40, 0.27, 0.18), (0.43, 0.41, 0.37)))
    egg = Piece("egg", (Part(revolve(egg_profile, 52), colour, "plastic"),))
    carton = Piece("egg_tray", (Part(tray, (0.22, 0.215, 0.20), "matt"),))
    # An egg finds the middle of its pocket, and all pockets are alike.
    z = 0.1 - drop(egg.moved((0.0, 0.0, 0.1)), [tray])
    eggs = _set_out(rng, egg, _grid(columns, rows, pitch), z, jitter=0.0)
    return [(carton, Pose(0.0, 0.0)), *eggs]


def brackets(rng: np.random.Generator) -> Panel:
    """Equal angle brackets, all facing one way."""
    large = bracket(rng)
    parts = [part._replace(solid=part.solid.bent(lambda v: 0.68 * v)) for part in large.parts]
    piece = Piece(large.kind, tuple(parts))
    flat = piece.solid().vertices[:, :2]
    step = np.ptp(flat, axis=0) + 0.012
    counts = np.maximum((2.0 * np.array(PANEL) / step).astype(int), 1)
    return _set_out(rng, piece, _grid(int(counts[0]), int(counts[1]), 1.0) * step)


def jars(rng: np.random.Generator) -> Panel:
    """Equal jars, open, shoulder to shoulder."""
    pitch, count = 0.062, 4
    r, tall = 0.41 * pitch, rng.uniform(0.05, 0.085)
    side = curve([(0.85 * r, 0.0), (r, 0.0), (r, 0.01), (r, 0.5 * tall), (r, 0.8 * tall),
                  (0.7 * r, 0.86 * tall), (0.7 * r, tall)], 0.006)  # fmt: skip
    solid = vessel(side, 0.003, 0.004, 64)
    colour = pick(rng, ((0.38, 0.37, 0.35), (0.06, 0.12, 0.22), (0.12, 0.21, 0.16)))
    piece = Piece("jar", (Part(solid, colour, "glazed"),))
    return _set_out(rng, piece, _grid(count, count, pitch))


def bolts(rng: np.random.Generator) -> Panel:
    """Equal bolts standing on their heads."""
    size, pitch = 0.016, 0.038
    solid = bolt_shape(size, rng.uniform(2.5, 3.5) * size)
    piece = Piece("stud", (Part(solid, pick(rng, STEEL), "steel"),))
    return _set_out(rng, piece, _grid(7, 7, pitch))


def heat_sinks(rng: np.random.Generator) -> Panel:
    """Equal finned heat sinks."""
    fins, pitch = int(rng.integers(7, 10)), 0.068
    half, tall, base = 0.43 * pitch, rng.uniform(0.025, 0.04), 0.005
    step = 2.0 * half / (fins - 0.5)
    comb = [[half, base]]
    for k in range(fins):
        right = half - k * step
        comb += [[right, tall], [right - 0.5 * step, tall]]
        if k < fins - 1:
            comb += [[right - 0.5 * step, base], [right - step, base]]
    outline = np.array([[-half, 0.0], [half, 0.0], *comb[1:]])
    solid = extrude(outline, 2.0 * half).moved((0.0, half, 0.0), UPRIGHT)
    piece = Piece("heat_sink", (Part(solid, pick(rng, ANODISED), "steel"),))
    return _set_out(rng, piece, _grid(4, 4, pitch))


PANELS: tuple[Callable[[np.random.Generator], Panel], ...] = (
    tube_rack, cubes, nut_board, egg_tray, brackets, jars, bolts, heat_sinks
)  # fmt: skip
