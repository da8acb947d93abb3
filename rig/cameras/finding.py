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
import types
import typing
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from depthba.errors import OptionError
from rig.cameras.camera import DepthCamera
from rig.errors import CameraError

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
    camera: DepthCamera = kind(options(kind.Options, values or {}, f"camera {name!r}"))
    return camera


def options(kind: Any, values: Mapping[str, Any], who: str) -> Any:
    """Return an instance of the dataclass `kind` from plain values; OptionError begins with `who`.

    A list becomes a tuple, a whole number a float, a text a Path where the field is one.
    """
    hints = typing.get_type_hints(kind)
    fields = {field.name: field for field in dataclasses.fields(kind) if field.init}
    unknown = [key for key in values if key not in fields]
    if unknown:
        choices = ", ".join(sorted(fields)) or "none"
        raise OptionError(f"{who}: unknown option {unknown[0]!r}; choose from: {choices}")
    missing = [
        name
        for name, field in fields.items()
        if name not in values
        and field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise OptionError(f"{who}: option {missing[0]!r} is missing")
    converted = {}
    for name, value in values.items():
        try:
            converted[name] = _converted(value, hints[name])
        except ValueError:
            hint = getattr(hints[name], "__name__", None) if isinstance(hints[name], type) else None
            expected = hint or str(hints[name]).replace("typing.", "")
            raise OptionError(f"{who}: option {name!r} is {value!r}, expected {expected}") from None
    return kind(**converted)


def _converted(value: Any, hint: Any) -> Any:
    """Return a value as its type hint wants it; ValueError where it does not fit."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        for choice in arguments:
            try:
                return _converted(value, choice)
            except ValueError:
                continue
        raise ValueError
    if origin is Literal:
        if value in arguments:
            return value
        raise ValueError
    if origin is tuple:
        return _converted_tuple(value, arguments)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    if origin is None and isinstance(hint, type):
        if isinstance(value, hint) and not (hint is int and isinstance(value, bool)):
            return value
        raise ValueError
    return value  # a hint that only the backend can judge


def _converted_tuple(value: Any, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise ValueError
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(value) != len(arguments):
        raise ValueError
    return tuple(_converted(v, hint) for v, hint in zip(value, arguments, strict=True))
