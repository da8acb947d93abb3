"""What may be asked of axes: checked before anything leaves for a controller."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.axes.axes import Axis
from rig.errors import AxesError

Array = NDArray[np.float64]


def check_axes(axes: Sequence[Axis]) -> None:
    """Refuse axes that make no sense: none, names twice, limits or a speed that allow nothing."""
    if not axes:
        raise AxesError("no axes, expected one or more")
    names = [axis.name for axis in axes]
    if len(set(names)) < len(names):
        raise AxesError(f"axes {', '.join(names)}, expected each name once")
    for axis in axes:
        finite = math.isfinite(axis.lower) and math.isfinite(axis.upper)
        if not finite or axis.lower >= axis.upper:
            raise AxesError(
                f"axis {axis.name}: limits {axis.lower:g} m to {axis.upper:g} m,"
                " expected lower below upper, both finite"
            )
        if not (math.isfinite(axis.speed) and axis.speed > 0):
            raise AxesError(f"axis {axis.name}: speed {axis.speed:g} m/s, expected above 0")


def check_target(axes: Sequence[Axis], target: ArrayLike) -> Array:
    """Return a target as an array (n,), m.

    Raises AxesError where its length is not that of the axes, where it is not finite, and where it
    lies outside the soft limits.
    """
    try:
        position = np.array(target, dtype=np.float64)
    except (TypeError, ValueError):
        raise AxesError(f"target {target!r}, expected {len(axes)} numbers, m") from None
    if position.shape != (len(axes),):
        raise AxesError(
            f"target of shape {position.shape}, expected ({len(axes)},):"
            f" {', '.join(axis.name for axis in axes)}, m"
        )
    for axis, value in zip(axes, position, strict=True):
        if not math.isfinite(value):
            raise AxesError(f"target of axis {axis.name} is {value:g}, expected a finite number, m")
        if not axis.lower <= value <= axis.upper:
            raise AxesError(
                f"target of axis {axis.name} is {value:.6g} m,"
                f" expected {axis.lower:g} m to {axis.upper:g} m"
            )
    return position


def check_speed(axes: Sequence[Axis], speed: float) -> float:
    """Return a speed along the line, m/s; AxesError where no axis or not every axis may run it."""
    slowest = min(axes, key=lambda axis: axis.speed)
    if not (math.isfinite(speed) and 0 < speed <= slowest.speed):
        raise AxesError(
            f"speed {speed:g} m/s, expected above 0 and at most {slowest.speed:g} m/s"
            f" (axis {slowest.name})"
        )
    return float(speed)


def described(axes: Sequence[Axis], position: Array) -> str:
    """Return a position (n,), m, in words, as "x 0.1 m, y 0.2 m"."""
    pairs = zip(axes, position, strict=True)
    return ", ".join(f"{axis.name} {value:.6g} m" for axis, value in pairs)
