"""Simulated capture: turns a scene and a seed into a dataset whose truth is exact.

`sim.generate("industrial-6", "my-dataset", sim.GenerateOptions(seed=1, size=(320, 240)))` does it
all; what else is public here are its parts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim.errors import SimulationError
    from sim.generation import Progress, generate, is_complete, rebuild
    from sim.options import GenerateOptions
    from sim.rendering.raycast import RayScene
    from sim.scenes import SCENES, Scene
    from sim.sensors import SENSORS, DepthSensor

_HOME = {
    "DepthSensor": "sim.sensors",
    "GenerateOptions": "sim.options",
    "Progress": "sim.generation",
    "RayScene": "sim.rendering.raycast",
    "SCENES": "sim.scenes",
    "SENSORS": "sim.sensors",
    "Scene": "sim.scenes",
    "SimulationError": "sim.errors",
    "generate": "sim.generation",
    "is_complete": "sim.generation",
    "rebuild": "sim.generation",
}

__all__ = [
    "SCENES",
    "SENSORS",
    "DepthSensor",
    "GenerateOptions",
    "Progress",
    "RayScene",
    "Scene",
    "SimulationError",
    "generate",
    "is_complete",
    "rebuild",
]


def __getattr__(name: str) -> Any:
    """Import what is asked for and no more: mujoco takes a moment."""
    if name not in _HOME:
        raise AttributeError(f"module 'sim' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_HOME[name]), name)
