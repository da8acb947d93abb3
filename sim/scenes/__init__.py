"""The scenes, by name: each a function of the seed that returns a MuJoCo model specification.

A new scene is one function and one entry here: what builds it, which rig drives over it and which
sensor looks at it.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

from sim.errors import SimulationError

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.engine import mujoco


@dataclass(frozen=True)
class Scene:
    """An entry of the registry."""

    id: str
    description: str
    builder: str | Callable[[int], mujoco.MjSpec]
    """A function of the seed, or `module:function`, imported when the scene is built."""
    rig: str
    """Name of the rig in `sim.rigs`."""
    sensor: str
    """Name of the sensor in `sim.sensors`."""

    def build(self, seed: int) -> mujoco.MjSpec:
        """The scene's specification; another seed gives another arrangement of the same kind."""
        if callable(self.builder):
            return self.builder(seed)
        module, function = self.builder.split(":")
        builder = getattr(importlib.import_module(module), function)
        return cast("Callable[[int], mujoco.MjSpec]", builder)(seed)


SCENES: dict[str, Scene] = {
    scene.id: scene
    for scene in (
        Scene(
            "industrial-6",
            "7 x 6 m bay of crushed stone, slag and scrap; a plate with several planes",
            "sim.scenes.industrial:industrial_6",
            rig="gantry",
            sensor="sp1000",
        ),
    )
}


def find_scene(name: str) -> Scene:
    """The scene called `name`; SimulationError lists the choices."""
    try:
        return SCENES[name]
    except KeyError:
        choices = ", ".join(sorted(SCENES))
        raise SimulationError(f"unknown scene {name!r}; choose one of: {choices}") from None
