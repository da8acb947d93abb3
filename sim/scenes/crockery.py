"""Crockery: hollow turned shapes with handles and spouts, and spoons."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim.scenes.arrangement import Colour, Part, Piece, pick
from sim.scenes.solids import Solid, arc, curve, joined, lump, revolve, tube

Array = NDArray[np.float64]

GLAZES: tuple[Colour, ...] = (
    (0.40, 0.395, 0.375), (0.055, 0.11, 0.22), (0.11, 0.21, 0.16), (0.34, 0.16, 0.07),
    (0.38, 0.29, 0.12), (0.25, 0.055, 0.045), (0.12, 0.125, 0.13), (0.24, 0.30, 0.33),
)  # fmt: skip


def vessel(outside: Array, wall: float, floor: float, segments: int = 128) -> Solid:
    """A hollow turned shape: its outside from the foot to the rim, walls `wall` m, open above."""
    ahead = np.gradient(outside, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    inside = outside + wall * np.column_stack([-ahead[:, 1], ahead[:, 0]])
    middle = 0.5 * (outside[-1] + inside[-1])
    start = np.arctan2(*(outside[-1] - middle)[::-1])
    rim = arc(middle, 0.5 * wall, start, start + np.pi, 9)
    inside = inside[(inside[:, 1] > floor + 0.0015) & (inside[:, 0] > 0.003)][::-1]
    # The first rise from the floor is rounded by one slanting step.
    bed = [[inside[-1, 0] - 0.002, floor], [0.0, floor]]
    return revolve(
        np.concatenate([[[0.0, 0.0]], outside, rim[1:-1], inside, bed]), segments
    )  # fmt: skip


def mug(rng: np.random.Generator) -> Piece:
    """A mug with a handle."""
    r, tall = rng.uniform(0.038, 0.046), rng.uniform(0.085, 0.105)
    waist = r * rng.uniform(0.86, 1.04)
    side = curve(
        [(r - 0.006, 0.0), (r - 0.001, 0.0), (r, 0.012), (waist, 0.5 * tall), (r, tall)], 0.006
    )
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 41)
    reach, high = rng.uniform(0.026, 0.034), rng.uniform(0.024, 0.03)
    z = 0.52 * tall + high * np.sin(angle)
    # Both ends stop within the wall.
    x = np.interp(z, side[:, 1], side[:, 0]) - 0.0022 + reach * np.cos(angle) ** 0.8
    path = np.column_stack([x, np.zeros(41), z])
    handle = tube(path, 0.0052, 40, flat=1.35)
    body = vessel(side, 0.0045, 0.005, 96)
    return Piece("mug", (Part(joined([body, handle]), pick(rng, GLAZES), "glazed"),))


def bowl_shape(rng: np.random.Generator) -> tuple[Piece, float]:
    """A bowl, and its inner radius, m."""
    r, tall = rng.uniform(0.112, 0.125), rng.uniform(0.055, 0.07)
    side = curve([(0.4 * r, 0.0), (0.46 * r, 0.0), (0.46 * r, 0.006), (0.75 * r, 0.008),
                  (0.98 * r, 0.55 * tall), (r, tall)], 0.006)  # fmt: skip
    solid = vessel(side, 0.005, 0.0105, 128)
    return Piece("bowl", (Part(solid, pick(rng, GLAZES), "glazed"),)), r - 0.005


def bowl(rng: np.random.Generator) -> Piece:
    """An empty bowl."""
    return bowl_shape(rng)[0]


def dish(rng: np.random.Generator) -> Piece:
    """A shallow dish with a fluted rim."""
    r = rng.uniform(0.07, 0.09)
    side = curve(
        [(0.5 * r, 0.0), (0.56 * r, 0.0), (0.6 * r, 0.004), (0.75 * r, 0.008), (r, 0.028)], 0.006
    )
    solid = vessel(side, 0.0045, 0.006, 128)
    waves = int(rng.integers(10, 17))

    def fluted(v: Array) -> Array:
        angle = np.arctan2(v[:, 1], v[:, 0])
        rise = np.clip(v[:, 2] / 0.028, 0.0, 1.0) ** 2
        grow = 1.0 + 0.035 * rise * np.cos(waves * angle)
        return np.column_stack([v[:, :2] * grow[:, None], v[:, 2]])

    return Piece("dish", (Part(solid.bent(fluted), pick(rng, GLAZES), "glazed"),))


def vase(rng: np.random.Generator) -> Piece:
    """A vase: belly, neck and lip; some are ribbed."""
    r, tall = rng.uniform(0.045, 0.062), rng.uniform(0.16, 0.235)
    neck, lip, at = rng.uniform(0.35, 0.5) * r, rng.uniform(0.5, 0.75) * r, rng.uniform(0.3, 0.55)
    side = curve([(0.55 * r, 0.0), (0.62 * r, 0.0), (1.15 * r, 0.15 * tall), (1.12 * r, at * tall),
                  (neck, 0.72 * tall), (neck, 0.88 * tall), (lip, tall)], 0.006)  # fmt: skip
    solid = vessel(side, 0.004, 0.006, 112)
    ribs, deep = int(rng.integers(9, 19)), rng.choice([0.0, 0.0, 0.03])
    twist = rng.uniform(-9.0, 9.0)

    def ribbed(v: Array) -> Array:
        phase = ribs * (np.arctan2(v[:, 1], v[:, 0]) + twist * v[:, 2])
        fade = np.sin(np.pi * np.clip(v[:, 2] / tall, 0.0, 1.0))
        return np.column_stack([v[:, :2] * (1.0 + deep * fade * np.cos(phase))[:, None], v[:, 2]])

    return Piece("vase", (Part(solid.bent(ribbed), pick(rng, GLAZES), "glazed"),))


def bottle(rng: np.random.Generator) -> Piece:
    """A corked bottle with rounded shoulders."""
    r, tall = rng.uniform(0.033, 0.039), rng.uniform(0.20, 0.23)
    side = curve([(0.8 * r, 0.0), (r, 0.0), (r, 0.02), (r, 0.2 * tall), (r, 0.5 * tall),
                  (r, 0.62 * tall), (0.40 * r, 0.70 * tall), (0.40 * r, 0.9 * tall)])  # fmt: skip
    lip = np.array([[0.47 * r, 0.905 * tall], [0.47 * r, 0.94 * tall], [0.36 * r, 0.945 * tall]])
    cork = np.array([[0.33 * r, 0.945 * tall], [0.36 * r, tall], [0.0, tall + 0.001]])
    glass = revolve(np.concatenate([[[0.0, 0.0]], side, lip, [[0.0, 0.945 * tall]]]))
    stopper = revolve(np.concatenate([[[0.0, 0.94 * tall]], cork]), 64)
    colour = pick(rng, ((0.03, 0.075, 0.035), (0.10, 0.045, 0.015), (0.05, 0.07, 0.11)))
    return Piece(
        "bottle", (Part(glass, colour, "polished"), Part(stopper, (0.30, 0.20, 0.11), "matt"))
    )


def teapot(rng: np.random.Generator) -> Piece:
    """A round teapot: spout, handle, lid with a knob."""
    r = rng.uniform(0.055, 0.068)
    body = revolve(
        np.concatenate([
            [[0.0, 0.0]],
            curve([(0.55 * r, 0.0), (0.62 * r, 0.0), (1.2 * r, 0.35 * r), (1.1 * r, 1.35 * r),
                   (0.4 * r, 1.62 * r), (0.36 * r, 1.63 * r)]),
            curve([(0.36 * r, 1.66 * r), (0.25 * r, 1.76 * r), (0.08 * r, 1.78 * r)]),
            curve([(0.08 * r, 1.82 * r), (0.26 * r, 1.92 * r), (0.15 * r, 2.06 * r),
                   (0.02 * r, 2.06 * r)], 0.0015),
            [[0.0, 2.06 * r]],
        ]), 112,
    )  # fmt: skip
    line = curve(
        [(0.85 * r, 0.55 * r), (1.35 * r, 0.6 * r), (1.45 * r, 1.2 * r), (1.75 * r, 1.5 * r)]
    )
    width = np.linspace(0.24 * r, 0.12 * r, len(line))
    spout = tube(np.column_stack([line[:, 0], 0.0 * line[:, 0], line[:, 1]]), width, 48)
    back = r * np.array([(-0.8, 1.3), (-1.5, 1.6), (-1.9, 1.0), (-1.4, 0.5), (-0.9, 0.55)])
    back = curve(back.tolist())
    handle = tube(np.column_stack([back[:, 0], 0.0 * back[:, 0], back[:, 1]]), 0.0055, 40, flat=1.3)
    return Piece("teapot", (Part(joined([body, spout, handle]), pick(rng, GLAZES), "glazed"),))


def spoon(rng: np.random.Generator) -> Piece:
    """A wooden spoon lying on its bowl and the end of its handle."""
    long = rng.uniform(0.16, 0.22)
    head = lump(rng, (0.032, 0.023, 0.011), 0.0, 1.0)

    def hollow(v: Array) -> Array:
        dip = 0.010 * np.exp(-((v[:, 0] / 0.021) ** 2 + (v[:, 1] / 0.015) ** 2))
        return np.column_stack([v[:, :2], v[:, 2] - np.where(v[:, 2] > 0.0, 1.4 * dip, 0.6 * dip)])

    path = np.column_stack(
        [np.linspace(0.026, long, 40), np.zeros(40), np.linspace(0.0, 0.004, 40)]
    )
    handle = tube(
        path, np.interp(np.linspace(0, 1, 40), [0, 0.2, 0.97, 1], [0.006, 0.0048, 0.007, 0.005]), 28
    )
    parts = (
        Part(head.bent(hollow), (0.33, 0.20, 0.095), "wood"),
        Part(handle, (0.33, 0.20, 0.095), "wood"),
    )
    return Piece("spoon", parts).moved((-0.5 * long, 0.0, 0.0)).settled()


CROCKERY: tuple[Callable[[np.random.Generator], Piece], ...] = (
    mug, mug, mug, vase, vase, bottle, dish, bowl, teapot, spoon, spoon,
)  # fmt: skip
