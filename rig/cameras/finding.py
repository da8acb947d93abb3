"""Finds a camera by its name: the built-in ones, and those that other packages bring.

A package brings one with a class and an entry point of the group ``depthba.cameras``::

    @dataclass(frozen=True)
    class Options:
        serial: str

    class MyCamera:
        Options = Options

        def __init__(self, options: Options): ...
        def open(self) -> CameraInfo: ...
        def capture(self, timeout: float) -> Capture: ...
        def close(self) -> None: ...

    [project.entry-points."depthba.cameras"]
    my-camera = "my_package.camera:MyCamera"

A backend's module is imported when it is asked for, and never before.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Mapping
from importlib import metadata
from typing import Any

from depthba.errors import OptionError
from rig.cameras.camera import DepthCamera
from rig.errors import CameraError
from rig.plain import from_plain

GROUP = "depthba.cameras"
"""Entry points of this group are cameras."""

_BUILT_IN = {
    "folder": "rig.cameras.folder:FolderCamera",
    "genicam": "rig.cameras.genicam:GenicamCamera",
    "realsense": "rig.cameras.realsense:RealSenseCamera",
    "zed": "rig.cameras.zed:ZedCamera",
}


def names() -> list[str]:
    """Return the names of all cameras there are, in order; imports none of them."""
    return sorted({*_BUILT_IN, *(point.name for point in metadata.entry_points(group=GROUP))})


def find(name: str) -> Any:
    """Return the class of a camera; its attribute `Options` is the dataclass that makes one.

    Raises:
        OptionError: there is no camera of that name.
        CameraError: its package cannot be imported, or has no such class.
        MissingPackage: a backend that cannot be without its package says so on its own.
    """
    if name in _BUILT_IN:
        module, _, attribute = _BUILT_IN[name].partition(":")
        return getattr(importlib.import_module(module), attribute)
    points = metadata.entry_points(group=GROUP, name=name)
    if not points:
        raise OptionError(f"unknown camera {name!r}; choose from: {', '.join(names())}")
    point = next(iter(points))
    try:
        found = point.load()
    except (ImportError, AttributeError) as error:
        raise CameraError(f"camera {name!r} ({point.value}) cannot be loaded: {error}") from error
    if not dataclasses.is_dataclass(getattr(found, "Options", None)):
        raise CameraError(
            f"camera {name!r} ({point.value}) has no dataclass Options,"
            " expected one that its constructor takes"
        )
    return found


def make(name: str, values: Mapping[str, Any] | None = None) -> DepthCamera:
    """Return a camera of that name, made but not opened.

    Args:
        name: as in `names`.
        values: its options by their names, as a session file has them.

    Raises what `find` raises, and OptionError for an option that is unknown, missing or of a wrong
    type.
    """
    kind = find(name)
    camera: DepthCamera = kind(from_plain(kind.Options, values or {}, f"camera {name!r}"))
    return camera
