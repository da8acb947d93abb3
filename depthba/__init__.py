"""Registers many depth frames of one scene at once: every frame's pose together with a depth map.

The public names are found when they are first used, so that ``import depthba`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from depthba.camera import Camera
    from depthba.dataset import Dataset, Frame
    from depthba.depth_map import DepthMap
    from depthba.errors import (
        Cancelled,
        DatasetError,
        DepthbaError,
        MissingPackage,
        OptionError,
        RunError,
    )
    from depthba.optimiser.live import Registration, Update
    from depthba.optimiser.register import register
    from depthba.options import Options
    from depthba.result import Iteration, Result

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Cancelled",
    "Dataset",
    "DatasetError",
    "DepthMap",
    "DepthbaError",
    "Frame",
    "Iteration",
    "MissingPackage",
    "OptionError",
    "Options",
    "Registration",
    "Result",
    "RunError",
    "Update",
    "__version__",
    "register",
]

_HOMES = {
    "Camera": "depthba.camera",
    "Cancelled": "depthba.errors",
    "Dataset": "depthba.dataset",
    "DatasetError": "depthba.errors",
    "DepthMap": "depthba.depth_map",
    "DepthbaError": "depthba.errors",
    "Frame": "depthba.dataset",
    "Iteration": "depthba.result",
    "MissingPackage": "depthba.errors",
    "OptionError": "depthba.errors",
    "Options": "depthba.options",
    "Registration": "depthba.optimiser.live",
    "Result": "depthba.result",
    "RunError": "depthba.errors",
    "Update": "depthba.optimiser.live",
    "register": "depthba.optimiser.register",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'depthba' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
