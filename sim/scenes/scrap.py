"""Scrap: off-cuts of plate, beam, pipe and bar that lie on the rubble, built from primitives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.engine import mujoco
from sim.scenes.relief import Relief, box_planes, rest_on_three, turned
from sim.scenes.stones import Keep

Array = NDArray[np.float64]

RUST = ((0.18, 0.082, 0.045), (0.13, 0.065, 0.042), (0.22, 0.115, 0.065))
STEEL = ((0.17, 0.175, 0.185), (0.12, 0.125, 0.135), (0.22, 0.22, 0.222))
PALETTES = {"rust": RUST, "steel": STEEL}
"""Colours, linear RGB, by the name of the material."""


@dataclass(frozen=True)
class Part:
    """A primitive of a body: half sizes as MuJoCo takes them, in the body's frame (m, rad)."""

    kind: mujoco.mjtGeom
    size: tuple[float, ...]
    position: tuple[float, float, float]
    tilt: float = 0.0
    """Rotation about the body's y axis."""
    lying: bool = False
    """True: a cylinder's axis lies along the body's x axis."""


@dataclass(frozen=True)
class Body:
    """Parts that move together; z = 0 is the underside, `half` its bounding half lengths, m."""

    parts: tuple[Part, ...]
    half: tuple[float, float, float]


BOX = mujoco.mjtGeom.mjGEOM_BOX
CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER


def box(
    half: tuple[float, float, float], at: tuple[float, float, float], tilt: float = 0.0
) -> Part:
    """A box of half lengths `half` with its centre `at`."""
    return Part(BOX, half, at, tilt)


def _plate(rng: np.random.Generator) -> Body:
    a, b, c = rng.uniform(0.12, 0.32), rng.uniform(0.07, 0.2), rng.uniform(0.004, 0.010)
    return Body((box((a, b, c), (0, 0, c)),), (a, b, c))


def _beam(rng: np.random.Generator) -> Body:
    """An I beam on its flange."""
    a, b = rng.uniform(0.2, 0.55), rng.uniform(0.022, 0.034)
    c, wall = b * rng.uniform(0.9, 1.2), 0.12 * b
    parts = (
        box((a, b, wall), (0, 0, wall)),
        box((a, wall, c - 2 * wall), (0, 0, c)),
        box((a, b, wall), (0, 0, 2 * c - wall)),
    )
    return Body(parts, (a, b, c))


def _angle(rng: np.random.Generator) -> Body:
    """An angle profile standing on one leg."""
    a, b, wall = rng.uniform(0.2, 0.5), rng.uniform(0.020, 0.032), 0.004
    parts = (box((a, b, wall), (0, 0, wall)), box((a, wall, b), (0, wall - b, b)))
    return Body(parts, (a, b, b))


def _pipe(rng: np.random.Generator) -> Body:
    a, r = rng.uniform(0.2, 0.6), rng.uniform(0.018, 0.035)
    return Body((Part(CYLINDER, (r, a), (0, 0, r), lying=True),), (a, r, r))


def _bar(rng: np.random.Generator) -> Body:
    a, r = rng.uniform(0.3, 0.8), rng.uniform(0.008, 0.02)
    return Body((Part(CYLINDER, (r, a), (0, 0, r), lying=True),), (a, r, r))


def _disc(rng: np.random.Generator) -> Body:
    r, c = rng.uniform(0.07, 0.18), rng.uniform(0.008, 0.014)
    return Body(
        (Part(CYLINDER, (r, c), (0, 0, c)), Part(CYLINDER, (0.4 * r, c), (0, 0, 2 * c))), (r, r, c)
    )


def _billet(rng: np.random.Generator) -> Body:
    a, b = rng.uniform(0.15, 0.35), rng.uniform(0.022, 0.032)
    return Body((box((a, b, b), (0, 0, b)),), (a, b, b))


KINDS = (_plate, _plate, _beam, _angle, _pipe, _bar, _bar, _disc, _billet)


def add_body(
    spec: mujoco.MjSpec,
    relief: Relief,
    body: Body,
    rotation: Array,
    position: Array,
    colours: list[Array],
    material: str,
    name: str = "",
) -> None:
    """Place a body (underside's centre at `position`), and lift the relief to its bounding box.

    `colours` is linear RGB per part; `material` names one of the model's.
    """
    for number, (part, colour) in enumerate(zip(body.parts, colours, strict=True)):
        cos, sin = np.cos(part.tilt), np.sin(part.tilt)
        turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        if part.lying:
            turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation @ turn).ravel())
        spec.worldbody.add_geom(
            name=f"{name}_{number}" if name else "",
            type=part.kind,
            size=[*part.size, 0.0, 0.0, 0.0][:3],
            pos=position + rotation @ np.array(part.position, float),
            quat=quaternion,
            rgba=[*np.clip(colour, 0.0, 1.0), 1.0],
            material=material,
        )
    centre = position + rotation[:, 2] * body.half[2]
    planes = turned(box_planes(body.half), rotation)
    relief.raise_to(planes, centre[0], centre[1], centre[2], float(np.hypot(*body.half[:2])) + 0.1)


def scatter_scrap(
    spec: mujoco.MjSpec,
    rng: np.random.Generator,
    relief: Relief,
    count: int,
    area: tuple[float, float, float, float],
    keep: tuple[Keep, ...],
) -> None:
    """Lay pieces of scrap on the relief, where the loader has driven them into the fines.

    Each piece takes the same numbers from `rng` whether or not it is kept.
    """
    for number in range(count):
        body = KINDS[int(rng.integers(len(KINDS)))](rng)
        x, y = rng.uniform(area[0], area[1]), rng.uniform(area[2], area[3])
        yaw = rng.uniform(0.0, 2.0 * np.pi)
        material = "rust" if rng.random() < 0.7 else "steel"
        palette = PALETTES[material]
        colour = np.array(palette[int(rng.integers(len(palette)))]) * rng.uniform(0.8, 1.2)
        if any(np.hypot(k.x - x, k.y - y) < k.radius + body.half[0] for k in keep):
            continue
        rotation, position = rest_on_three(relief, x, y, yaw, body.half[:2], pressed=1.0)
        colours = [colour] * len(body.parts)
        add_body(spec, relief, body, rotation, position, colours, material, f"scrap_{number}")
