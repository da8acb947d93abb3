"""Scenes that are built in no time, by name, so that other processes find them too."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from sim.engine import mujoco
from sim.seeds import stream

TROUBLE = "HEAPS_TROUBLE"
"""Names a folder for `troubled`, which keeps its tries there."""


def heap(seed: int) -> mujoco.MjSpec:
    """A few boxes on a plane and one marker."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9, 9, 0.1])
    rng = stream(seed, "heap")
    for _ in range(12):
        size, place = rng.uniform(0.05, 0.3, 3), rng.uniform(-1.0, 3.0, 2)
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=[*place, size[2]], rgba=[0.4, 0.3, 0, 1]
        )
    spec.worldbody.add_geom(
        name="marker_only",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[0.1, 0.002, 0],
        pos=[0.2, 1.0, 0.7],
    )
    return spec


def troubled(seed: int) -> mujoco.MjSpec:
    """Seed 1 fails always, seed 2 the first time; seed 3 dies always, seed 4 the first time."""
    tries = Path(os.environ[TROUBLE]) / f"{seed}"
    first = not tries.exists()
    with tries.open("a") as file:
        file.write("x")
    if seed == 1 or (seed == 2 and first):
        raise ArithmeticError("the heap\nfalls over")
    if seed == 3 or (seed == 4 and first):
        os.kill(os.getpid(), signal.SIGKILL)
    return heap(seed)
