"""The laboratory table with the arm on it, and the floor around.

World: the arm's base frame (UR "base"), origin on the table's top, z up. The arm stands near the
back edge; the work area in front of it is where things are set out.
"""

from __future__ import annotations

import numpy as np

from sim.engine import mujoco
from sim.robots.ur16e import add_ur16e
from sim.scenes.arrangement import Bench, Plot, Pose
from sim.scenes.solids import extrude, joined, rectangle

TABLE_X = (-1.2, 1.2)
TABLE_Y = (-0.2, 1.0)
TABLE_HEIGHT = 0.7
"""The top's extent and its height above the floor, m."""

WORK_AREA = (-0.60, 0.60, 0.22, 0.85)
"""Where things stand: xmin, xmax, ymin, ymax, m."""

_THICK = 0.04
_STAVE = 0.06
_BEECH = np.array([0.36, 0.25, 0.145])


def add_table(spec: mujoco.MjSpec, rng: np.random.Generator) -> Plot:
    """Put table, floor and arm into a model; returns the work area, to set things out on."""
    bench = Bench(spec)
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[4.0, 4.0, 0.1],
        pos=[0.0, 0.4, -TABLE_HEIGHT],
        rgba=[0.13, 0.132, 0.13, 1.0],
    )
    _add_top(spec, rng)
    _add_frame(spec)
    add_ur16e(spec)
    x0, x1, y0, y1 = WORK_AREA
    half = 0.5 * (x1 - x0), 0.5 * (y1 - y0)
    return Plot(bench, half, Pose(0.5 * (x0 + x1), 0.5 * (y0 + y1)), height=0.25)


def _add_top(spec: mujoco.MjSpec, rng: np.random.Generator) -> None:
    """Beech staves glued edge to edge in six tints; a single box stands in for collisions."""
    middle = [0.5 * sum(TABLE_X), 0.5 * sum(TABLE_Y), -0.5 * _THICK]
    half = [0.5 * (TABLE_X[1] - TABLE_X[0]), 0.5 * (TABLE_Y[1] - TABLE_Y[0]), 0.5 * _THICK]
    spec.worldbody.add_geom(
        name="table_top", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=middle, group=3
    )
    tints: list[list] = [[] for _ in range(6)]
    for row in range(round(2.0 * half[1] / _STAVE)):
        y = TABLE_Y[0] + (row + 0.5) * _STAVE
        x = TABLE_X[0] - rng.uniform(0.0, 0.5)
        while x < TABLE_X[1]:
            end = x + rng.uniform(0.45, 0.9)
            low, high = max(x, TABLE_X[0]), min(end, TABLE_X[1])
            x = end
            if high > low:
                outline = rectangle(0.5 * (high - low), 0.5 * _STAVE, (0.5 * (low + high), y))
                tints[int(rng.integers(6))].append(extrude(outline, _THICK, bottom=-_THICK))
    for k, (staves, tint) in enumerate(zip(tints, np.linspace(0.86, 1.12, 6), strict=True)):
        if not staves:
            continue
        solid = joined(staves)
        spec.add_mesh(
            name=f"staves_{k}", uservert=solid.vertices.ravel(), userface=solid.faces.ravel()
        )
        spec.worldbody.add_geom(
            name=f"staves_{k}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"staves_{k}",
            rgba=[*(_BEECH * tint * [1.0, 1.0, 2.0 - tint]), 1.0],
            material="wood",
            contype=0,
            conaffinity=0,
        )


def _add_frame(spec: mujoco.MjSpec) -> None:
    """Four legs and the rails between them, painted steel tube."""
    x0, x1, y0, y1 = TABLE_X[0] + 0.06, TABLE_X[1] - 0.06, TABLE_Y[0] + 0.06, TABLE_Y[1] - 0.06
    long, wide = 0.5 * (x1 - x0), 0.5 * (y1 - y0)
    leg = 0.5 * (TABLE_HEIGHT - _THICK)
    bars = {
        f"leg_{k}": ([x, y, -_THICK - leg], [0.03, 0.03, leg])
        for k, (x, y) in enumerate(((x0, y0), (x1, y0), (x1, y1), (x0, y1)))
    }
    for k, y in enumerate((y0, y1)):
        bars[f"rail_{k}"] = [0.5 * (x0 + x1), y, -_THICK - 0.03], [long - 0.03, 0.02, 0.03]
    for k, x in enumerate((x0, x1)):
        bars[f"rail_{k + 2}"] = [x, 0.5 * (y0 + y1), -_THICK - 0.03], [0.02, wide - 0.03, 0.03]
    for name, (position, size) in bars.items():
        spec.worldbody.add_geom(
            name=f"table_{name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=size,
            pos=position,
            rgba=[0.10, 0.11, 0.12, 1.0],
            material="painted",
        )
