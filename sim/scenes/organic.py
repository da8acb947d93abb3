"""Fruit, bread, stones and cloth: lumps and folds without planes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from sim.scenes.arrangement import Colour, Part, Piece, pick
from sim.scenes.solids import LYING, about, curve, lump, revolve, sheet, tube

Array = NDArray[np.float64]

CLOTH: tuple[Colour, ...] = ((0.10, 0.16, 0.28), (0.36, 0.32, 0.26), (0.30, 0.09, 0.08),
                             (0.13, 0.20, 0.13), (0.38, 0.27, 0.10))  # fmt: skip
CRUST: Colour = (0.27, 0.135, 0.05)
STALK: Colour = (0.10, 0.075, 0.04)


def apple(rng: np.random.Generator) -> Piece:
    """An apple with its dimples and stalk, standing as it lies best."""
    r = rng.uniform(0.034, 0.042)
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 45)
    dent = 1.0 - 0.55 * np.exp(-(((0.5 * np.pi - np.abs(angle)) / 0.42) ** 2))
    profile = r * np.column_stack([1.05 * np.cos(angle), 0.92 * np.sin(angle) * dent])
    profile[[0, -1], 0] = 0.0
    body = revolve(profile, 80)
    phase = rng.uniform(0.0, 6.0)

    def lobed(v: Array) -> Array:
        grow = 1.0 + 0.025 * np.cos(5.0 * np.arctan2(v[:, 1], v[:, 0]) + phase)
        lean = 1.0 + 1.1 * v[:, 2] * grow
        return np.column_stack([v[:, :2] * (grow * lean)[:, None], v[:, 2]])

    stalk = tube(
        np.array([[0.0, 0.0, 0.3 * r], [0.001, 0.0, 0.6 * r], [0.004, 0.0, 0.95 * r]]), 0.0013, 16
    )
    colour = pick(rng, ((0.33, 0.035, 0.025), (0.20, 0.29, 0.035), (0.36, 0.20, 0.04)))
    tilt = about(0, rng.uniform(-0.4, 0.4))
    parts = (Part(body.bent(lobed), colour, "plastic"), Part(stalk, STALK, "matt"))
    return Piece("apple", parts).moved((0.0, 0.0, 0.0), tilt).settled()


def orange(rng: np.random.Generator) -> Piece:
    """An orange, nearly round."""
    r = rng.uniform(0.034, 0.041)
    solid = lump(rng, (r, r, 0.94 * r), 0.012, 2.5)
    return Piece("orange", (Part(solid, (0.45, 0.17, 0.015), "plastic"),)).settled()


def lemon(rng: np.random.Generator) -> Piece:
    """A lemon lying on its side."""
    r, long = rng.uniform(0.025, 0.029), rng.uniform(0.04, 0.046)
    side = curve([(0.004, -long), (0.006, -0.9 * long), (0.9 * r, -0.8 * long), (1.25 * r, 0.0),
                  (0.9 * r, 0.8 * long), (0.006, 0.9 * long), (0.004, long)])  # fmt: skip
    solid = revolve(np.concatenate([[[0.0, -long]], side, [[0.0, long]]]), 96).moved(turn=LYING)
    return Piece("lemon", (Part(solid, (0.46, 0.35, 0.025), "plastic"),)).settled()


def pear(rng: np.random.Generator) -> Piece:
    """A pear lying on its side."""
    r, tall = rng.uniform(0.031, 0.037), rng.uniform(0.08, 0.095)
    side = curve([(0.3 * r, 0.0), (1.15 * r, 0.0), (1.25 * r, 0.42 * tall), (0.55 * r, 0.65 * tall),
                  (0.6 * r, 0.98 * tall), (0.15 * r, tall)])  # fmt: skip
    body = revolve(np.concatenate([[[0.0, 0.003]], side, [[0.0, 0.995 * tall]]]), 96)
    stalk = tube(
        np.array([[0, 0, 0.97 * tall], [0.001, 0, tall + 0.008], [0.005, 0, tall + 0.018]]),
        0.0014,
        16,
    )
    parts = (Part(body, (0.30, 0.31, 0.06), "plastic"), Part(stalk, STALK, "matt"))
    return Piece("pear", parts).moved((-0.4 * tall, 0.0, 0.0), LYING).settled()


def banana(rng: np.random.Generator) -> Piece:
    """A banana lying on its side."""
    bend, r = rng.uniform(0.08, 0.11), rng.uniform(0.015, 0.018)
    span = rng.uniform(0.15, 0.18) / bend
    angle = np.linspace(-0.5 * span, 0.5 * span, 90)
    path = np.column_stack([bend * np.sin(angle), bend * np.cos(angle) - 0.9 * bend, 0.0 * angle])
    s = np.linspace(0.0, 1.0, 90)
    width = r * np.interp(
        s, [0.0, 0.05, 0.14, 0.3, 0.7, 0.9, 0.97, 1.0], [0.3, 0.28, 0.45, 0.95, 1.0, 0.6, 0.25, 0.2]
    )
    width = np.convolve(np.pad(width, 4, mode="edge"), np.ones(9) / 9.0, "valid")
    return Piece("banana", (Part(tube(path, width, 40), (0.45, 0.32, 0.035), "plastic"),)).settled()


def pumpkin(rng: np.random.Generator) -> Piece:
    """A ribbed pumpkin with its stalk."""
    r, ribs = rng.uniform(0.065, 0.085), int(rng.integers(8, 12))
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 49)
    dent = 1.0 - 0.35 * np.exp(-(((0.5 * np.pi - np.abs(angle)) / 0.5) ** 2))
    profile = r * np.column_stack([np.cos(angle), 0.74 * np.sin(angle) * dent])
    profile[[0, -1], 0] = 0.0
    body = revolve(profile, 160)

    def ribbed(v: Array) -> Array:
        phase = ribs * np.arctan2(v[:, 1], v[:, 0])
        return v * (1.0 - 0.10 * (1.0 - np.abs(np.cos(0.5 * phase)) ** 0.7))[:, None]

    line = np.array([[0, 0, 0.3 * r], [0, 0, 0.62 * r], [0.003, 0, 0.75 * r], [0.013, 0, 0.9 * r]])
    stalk = tube(line, np.array([0.013, 0.010, 0.007, 0.006]), 24)
    parts = (Part(body.bent(ribbed), (0.40, 0.15, 0.02), "plastic"), Part(stalk, STALK, "matt"))
    return Piece("pumpkin", parts).settled()


def potato(rng: np.random.Generator) -> Piece:
    """A potato."""
    r = rng.uniform(0.026, 0.034)
    half = (1.35 * r, r, 0.85 * r)
    return Piece(
        "potato", (Part(lump(rng, half, 0.06, 3.0), (0.27, 0.18, 0.085), "matt"),)
    ).settled()


def pebble(rng: np.random.Generator) -> Piece:
    """A river stone lying flat."""
    r = rng.uniform(0.022, 0.048)
    half = (r, rng.uniform(0.65, 0.9) * r, rng.uniform(0.4, 0.6) * r)
    colour = pick(
        rng, ((0.16, 0.155, 0.15), (0.09, 0.092, 0.098), (0.28, 0.265, 0.24), (0.19, 0.14, 0.11))
    )
    return Piece("pebble", (Part(lump(rng, half, 0.035, 2.2), colour, "matt"),)).settled()


def loaf(rng: np.random.Generator) -> Piece:
    """A loaf of bread with three cuts across."""
    long, wide, tall = rng.uniform(0.10, 0.13), rng.uniform(0.048, 0.058), rng.uniform(0.05, 0.06)
    solid = lump(rng, (long, wide, tall), 0.03, 2.5, level=5)

    def baked(v: Array) -> Array:
        cut = np.abs(((v[:, 0] + 0.35 * v[:, 1]) / (0.55 * long) + 0.5) % 1.0 - 0.5) * 0.55 * long
        top = np.clip(v[:, 2] / tall, 0.0, 1.0)
        z = v[:, 2] - 0.012 * top * np.exp(-((cut / 0.008) ** 2))
        return np.column_stack([v[:, :2], np.maximum(z + 0.3 * tall, 0.0)])

    return Piece("loaf", (Part(solid.bent(baked), CRUST, "matt"),))


def cushion(rng: np.random.Generator) -> Piece:
    """A square cushion, thick in the middle and pinched at its corners."""
    a, tall = rng.uniform(0.095, 0.12), rng.uniform(0.036, 0.046)
    sphere = lump(rng, (1.0, 1.0, 1.0), 0.012, 4.0, level=5)

    def pinched(v: Array) -> Array:
        flat = v[:, :2]
        # From the disc to the square, its sides drawn in a little between the corners.
        reach = np.linalg.norm(flat, axis=1)
        square = flat * (reach / np.maximum(np.abs(flat).max(axis=1), 1e-12))[:, None]
        x, y = square.T
        drawn = square * (1.0 - 0.10 * (1.0 - np.minimum(np.abs(square), 1.0)[:, ::-1] ** 2))
        puff = (
            np.sign(v[:, 2]) * np.abs((1 - np.minimum(x**2, 1)) * (1 - np.minimum(y**2, 1))) ** 0.55
        )
        crease = 1.0 + 0.05 * np.sin(7.0 * np.arctan2(y, x) + 1.0) * np.minimum(reach, 1.0) ** 4
        z = tall * puff * crease
        return np.column_stack([a * drawn, np.maximum(z + 0.7 * tall, 0.0)])

    return Piece("cushion", (Part(sphere.bent(pinched), pick(rng, CLOTH), "matt"),))


def towel(rng: np.random.Generator) -> Piece:
    """A cloth thrown on the table: folds that run in a few directions, thin at its hem."""
    a, b, n = rng.uniform(0.11, 0.14), rng.uniform(0.08, 0.1), 80
    y, x = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    height = np.zeros((n, n))
    for _ in range(7):
        heading, at = rng.uniform(0.0, np.pi), rng.uniform(-0.6, 0.6)
        bow, wide = rng.uniform(-0.5, 0.5), rng.uniform(0.10, 0.2)
        across = x * np.cos(heading) + y * np.sin(heading) - at
        along = -x * np.sin(heading) + y * np.cos(heading) - rng.uniform(-0.6, 0.6)
        ridge = np.exp(-(((across + bow * along**2) / wide) ** 2) - (along / 0.9) ** 2)
        height = np.maximum(height, rng.uniform(0.018, 0.045) * ridge)
    height = gaussian_filter(height, 1.6)
    hem = np.clip((1.0 - np.maximum(np.abs(x), np.abs(y))) / 0.15, 0.0, 1.0)
    solid = sheet(0.003 + height * (0.35 + 0.65 * hem), a, b)
    sway = rng.uniform(-0.15, 0.15, 4)

    def ragged(v: Array) -> Array:
        x, y = v[:, 0] / a, v[:, 1] / b
        shift = np.column_stack(
            [sway[0] * y**2 + sway[1] * x * y, sway[2] * x**2 + sway[3] * x * y]
        )
        return np.column_stack([v[:, :2] + 0.5 * b * shift, v[:, 2]])

    return Piece("towel", (Part(solid.bent(ragged), pick(rng, CLOTH), "matt"),))


FRUIT: tuple[Callable[[np.random.Generator], Piece], ...] = (
    apple, orange, lemon, pear, potato, apple, orange,
)  # fmt: skip
