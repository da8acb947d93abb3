"""Makes axes by the name of their controller, from plain values as a session file has them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from depthba.errors import OptionError
from rig.axes.axes import Axes
from rig.axes.grbl import GrblGantry, GrblOptions
from rig.axes.modbus import ModbusGantry, ModbusOptions
from rig.plain import from_plain

_KINDS: dict[str, tuple[Any, Any]] = {
    "grbl": (GrblGantry, GrblOptions),
    "modbus": (ModbusGantry, ModbusOptions),
}


def names() -> list[str]:
    """Return the names of all controllers there are."""
    return sorted(_KINDS)


def make(name: str, values: Mapping[str, Any]) -> Axes:
    """Return the axes behind a controller of that name, made but not connected.

    Args:
        name: as in `names`.
        values: the options by their names; an axis is a mapping of name, lower, upper and speed.

    Raises:
        OptionError: an unknown name; an option that is unknown, missing or of a wrong type.
        AxesError: options that make no sense.
    """
    if name not in _KINDS:
        raise OptionError(f"unknown axes {name!r}; choose from: {', '.join(names())}")
    kind, options = _KINDS[name]
    axes: Axes = kind(from_plain(options, values, f"axes {name!r}"))
    return axes
