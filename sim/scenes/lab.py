"""The three laboratory scenes: what stands in the work area of the arm's table.

Each is a function of the seed; another seed gives another arrangement of the same kind.
"""

from __future__ import annotations

import numpy as np

from sim.engine import mujoco
from sim.scenes.arrangement import Piece, Plot, Pose, Shelf, drop
from sim.scenes.crockery import CROCKERY, bowl_shape
from sim.scenes.machined import MACHINED, THREADS, block, bolt, bush, nut
from sim.scenes.organic import (
    FRUIT,
    apple,
    banana,
    cushion,
    lemon,
    loaf,
    orange,
    pebble,
    potato,
    pumpkin,
    towel,
)
from sim.scenes.rows import PANELS
from sim.scenes.table import add_table
from sim.scenes.tools import TOOLS, carton, crate, toolbox
from sim.seeds import stream


def lab_1(seed: int) -> mujoco.MjSpec:
    """Boxes, tools and machined parts with holes."""
    spec, plot = _table(seed, "lab-1")
    rng = stream(seed, "lab-1", "pieces")
    makers = [
        crate,
        carton,
        toolbox,
        carton,
        block,
        block,
        *MACHINED,
        *MACHINED,
        *TOOLS,
        *TOOLS[:4],
    ]
    pieces = [maker(rng) for maker in makers]
    for piece in sorted(pieces, key=_spread, reverse=True):
        pose = plot.scatter(rng, piece)
        if pose is not None and piece.shelf is not None:
            _load(rng, plot, piece.shelf, pose)
    bushes = [bush(rng) for _ in range(3)]
    for _ in range(14):
        size = THREADS[int(rng.integers(3))]
        for piece in (nut(size), bolt(size, 3.2 * size), bushes[int(rng.integers(3))]):
            plot.scatter(rng, piece)
    return spec


def _table(seed: int, scene: str) -> tuple[mujoco.MjSpec, Plot]:
    spec = mujoco.MjSpec()
    spec.modelname = scene
    return spec, add_table(spec, stream(seed, scene, "table"))


def _spread(piece: Piece) -> float:
    """The area of a piece's bounding rectangle seen from above, m²."""
    flat = np.concatenate([part.solid.vertices[:, :2] for part in piece.parts])
    return float(np.prod(np.ptp(flat, axis=0)))


def _load(rng: np.random.Generator, plot: Plot, shelf: Shelf, pose: Pose) -> None:
    """Stand some parts on a piece's shelf."""
    top = pose.at(Pose(0.0, 0.0, shelf.height))
    onto = Plot(plot.bench, (shelf.half_x, shelf.half_y), top, height=plot.height - top.z)
    for _ in range(3):
        onto.scatter(rng, MACHINED[int(rng.integers(len(MACHINED)))](rng))
    for _ in range(3):
        onto.scatter(rng, nut(THREADS[int(rng.integers(3))]))


def lab_2(seed: int) -> mujoco.MjSpec:
    """Curved household and organic shapes, few planes."""
    spec, plot = _table(seed, "lab-2")
    rng = stream(seed, "lab-2", "pieces")
    makers = [*CROCKERY, cushion, towel, towel, loaf, pumpkin, banana, banana, *FRUIT]
    vessel, inner = bowl_shape(rng)
    pose = plot.scatter(rng, vessel)
    if pose is not None:
        _fill_bowl(rng, plot, vessel, inner, pose)
    pieces = [maker(rng) for maker in makers]
    for piece in sorted(pieces, key=_spread, reverse=True):
        plot.scatter(rng, piece)
    small = [maker(rng) for maker in (pebble, pebble, pebble, pebble, potato, lemon)]
    for k in range(13):
        plot.scatter(rng, small[k % len(small)])
    return spec


def _fill_bowl(
    rng: np.random.Generator, plot: Plot, vessel: Piece, inner: float, pose: Pose
) -> None:
    """Let three fruits down into a bowl side by side, and one on top of them."""
    lying = [vessel.solid()]
    start = rng.uniform(0.0, 2.0 * np.pi)
    for k in range(4):
        fruit = (apple, orange, apple, orange)[k](rng)
        wide = float(np.linalg.norm(fruit.solid().vertices[:, :2], axis=1).max())
        off = 0.0 if k == 3 else min(1.18 * wide, inner - wide - 0.012)
        angle = start + 2.0 * np.pi * k / 3.0
        x, y = off * float(np.cos(angle)), off * float(np.sin(angle))
        above = fruit.moved((x, y, 0.3))
        z = 0.3 - drop(above, lying)
        if pose.z + z + 2.0 * wide > plot.height:
            break
        lying.append(fruit.solid().moved((x, y, z)))
        plot.bench.add(fruit, pose.at(Pose(x, y, z)))


def lab_3(seed: int) -> mujoco.MjSpec:
    """Equal parts in grids, racks and rows, which look alike from one pitch to the next."""
    spec, plot = _table(seed, "lab-3")
    rng = stream(seed, "lab-3", "panels")
    places = [(x, y) for y in (-0.25, 0.25) for x in (-0.375, -0.125, 0.125, 0.375)]
    for (x, y), number in zip(places, rng.permutation(len(PANELS)), strict=True):
        at = np.array([x, y]) * 2.0 * np.array(plot.half) + rng.uniform(-0.004, 0.004, 2)
        yaw = np.radians(rng.uniform(-2.0, 2.0))
        panel = plot.at.at(Pose(float(at[0]), float(at[1]), yaw=float(yaw)))
        for piece, pose in PANELS[number](rng):
            plot.bench.add(piece, panel.at(pose))
    return spec
