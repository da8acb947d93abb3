"""The scenes, by name: each a function of the seed that returns a MuJoCo model specification.

A new scene is one function and one entry here: what builds it, which rig drives over it and which
sensor looks at it. Without an entry, `module:function` and the path of an MJCF file name one too.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from sim.errors import SimulationError

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.engine import mujoco
    from sim.rigs import Rig
    from sim.sensors import DepthSensor


@dataclass(frozen=True)
class Scene:
    """An entry of the registry."""

    id: str
    description: str
    builder: str | Callable[[int], mujoco.MjSpec]
    """A function of the seed, or `module:function`, imported when the scene is built."""
    rig: str | Rig
    """Name of the rig in `sim.rigs`, or a rig of one's own."""
    sensor: str | DepthSensor
    """Name of the sensor in `sim.sensors`, or a sensor of one's own."""

    def build(self, seed: int, settled: bool = False) -> mujoco.MjSpec:
        """The scene's specification; another seed gives another arrangement of the same kind.

        `settled` lets loose bodies come to rest under physics first. SimulationError where a
        builder that is given by name cannot be found, or returns something else.
        """
        spec = self._function()(seed)
        from sim.engine import mujoco

        if not isinstance(spec, mujoco.MjSpec):
            raise SimulationError(
                f"scene {self.id}: its builder returned {type(spec).__name__}, expected an MjSpec"
            )
        if settled:
            from sim.scenes.settling import settle

            return settle(spec)
        return spec

    def _function(self) -> Callable[[int], mujoco.MjSpec]:
        if callable(self.builder):
            return self.builder
        module, _, function = self.builder.partition(":")
        try:
            found = getattr(importlib.import_module(module), function)
        except ModuleNotFoundError as error:
            if error.name is None or not module.startswith(error.name):
                raise
            raise SimulationError(
                f"scene {self.builder}: no module {error.name!r}, expected one that can be imported"
            ) from None
        except AttributeError:
            raise SimulationError(
                f"scene {self.builder}: module {module} has no {function!r}, expected a function"
            ) from None
        return cast("Callable[[int], mujoco.MjSpec]", found)


_BAY = "7 x 6 m bay of crushed stone, slag and scrap"
_TABLE = "table of 2.4 x 1.2 x 0.7 m with the arm on it"

SCENES: dict[str, Scene] = {
    scene.id: scene
    for scene in (
        Scene(
            "lab-1",
            f"{_TABLE}; boxes, tools and machined parts with holes",
            "sim.scenes.lab:lab_1",
            rig="arm",
            sensor="zed2",
        ),
        Scene(
            "lab-2",
            f"{_TABLE}; curved household and organic shapes, few planes",
            "sim.scenes.lab:lab_2",
            rig="arm",
            sensor="zed2",
        ),
        Scene(
            "lab-3",
            f"{_TABLE}; repetitive parts: grids, racks, equal parts in rows",
            "sim.scenes.lab:lab_3",
            rig="arm",
            sensor="zed2",
        ),
        Scene(
            "industrial-4",
            f"{_BAY}; a steel slab and billets",
            "sim.scenes.industrial:industrial_4",
            rig="gantry",
            sensor="sp1000",
        ),
        Scene(
            "industrial-5",
            f"{_BAY}; a steel coil",
            "sim.scenes.industrial:industrial_5",
            rig="gantry",
            sensor="sp1000",
        ),
        Scene(
            "industrial-6",
            f"{_BAY}; a plate with several planes",
            "sim.scenes.industrial:industrial_6",
            rig="gantry",
            sensor="sp1000",
        ),
        Scene(
            "handeye-board",
            f"{_TABLE}; a checkerboard to calibrate the hand-eye transform with",
            "sim.scenes.board:handeye_board",
            rig="board-arm",
            sensor="zed2",
        ),
        Scene(
            "handeye-charuco",
            f"{_TABLE}; a ChArUco board to calibrate the hand-eye transform with",
            "sim.scenes.board:handeye_charuco",
            rig="board-arm",
            sensor="zed2",
        ),
    )
}


def find_scene(name: str) -> Scene:
    """The scene called `name`: of the registry, the path of an MJCF file, or `module:function`.

    SimulationError lists the choices.
    """
    if name in SCENES:
        return SCENES[name]
    path = Path(name)
    if path.suffix.lower() in (".xml", ".mjcf"):
        if not path.is_file():
            raise SimulationError(f"scene {name}: no such file, expected an MJCF model")
        from sim.scenes.own import MjcfFile

        return Scene(path.stem, f"the model in {name}", MjcfFile(path), rig="dome", sensor="zed2")
    module, colon, function = name.partition(":")
    if colon and function.isidentifier() and all(p.isidentifier() for p in module.split(".")):
        return Scene(function, f"built by {name}", name, rig="dome", sensor="zed2")
    raise SimulationError(
        f"unknown scene {name!r}; choose one of: {', '.join(sorted(SCENES))};"
        " or give an MJCF file (.xml) or module:function"
    )
