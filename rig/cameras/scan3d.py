"""Range images as GenICam's 3D cameras send them, turned into depth.

After the chapter 3D Scan Control of GenICam's Standard Features Naming Convention, and the names of
its Pixel Format Naming Convention.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.errors import CameraError

UNITS = {"Millimeter": 1e-3, "Meter": 1.0, "Inch": 0.0254}
"""Metres of a Scan3dDistanceUnit."""
_FORMAT = re.compile(r"Coord3D_([ABC]+)(8|16|32f)(_Planar)?")
_COLOURS = {
    "RGB8": (0, 1, 2),
    "RGBa8": (0, 1, 2),
    "BGR8": (2, 1, 0),
    "BGRa8": (2, 1, 0),
    "Mono8": (0, 0, 0),
}


@dataclass(frozen=True, eq=False)
class Part:
    """One image of what a camera sent in one go."""

    format: str
    """As ``Coord3D_C16``, ``RGB8``."""
    width: int
    height: int
    data: NDArray
    """The numbers in the order in which they came, one dimension."""


@dataclass(frozen=True)
class Scan3d:
    """What turns the numbers of coordinate C into z."""

    scale: float = 1.0
    """Scan3dCoordinateScale."""
    offset: float = 0.0
    """Scan3dCoordinateOffset."""
    invalid: float | None = None
    """Scan3dInvalidDataValue where Scan3dInvalidDataFlag is set, of the numbers as they came."""
    metres: float = 1e-3
    """Of one Scan3dDistanceUnit."""


def depth_of(parts: Sequence[Part], scan: Scan3d) -> NDArray[np.float32]:
    """Return depth (height, width), m, from the part that has coordinate C.

    NaN where the number is the invalid one, is not finite, or is a depth that is not above 0.
    CameraError where no part has coordinate C, or where one is not as long as its size says.
    """
    for part in parts:
        match = _FORMAT.fullmatch(part.format)
        if match is not None and "C" in match[1]:
            break
    else:
        found = ", ".join(part.format for part in parts) or "nothing"
        raise CameraError(f"genicam: {found} came, expected a Coord3D format with coordinate C")
    letters, planar = match[1], match[3] is not None
    size = part.height * part.width
    if part.data.size != size * len(letters):
        raise CameraError(
            f"genicam: {part.format} of {part.width} x {part.height} with {part.data.size} numbers,"
            f" expected {size * len(letters)}"
        )
    if planar:
        raw = part.data.reshape(len(letters), size)[letters.index("C")]
    else:
        raw = part.data.reshape(size, len(letters))[:, letters.index("C")]
    z = (raw.astype(np.float64) * scan.scale + scan.offset) * scan.metres
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(z) & (z > 0)
    if scan.invalid is not None:
        seen &= raw != scan.invalid
    return np.where(seen, z, np.nan).astype(np.float32).reshape(part.height, part.width)


def colour_of(parts: Sequence[Part], shape: tuple[int, int]) -> NDArray[np.uint8] | None:
    """Return colour (height, width, 3), RGB, of that shape (height, width); None: there is none."""
    for part in parts:
        order = _COLOURS.get(part.format)
        if order is None or (part.height, part.width) != shape:
            continue
        channels = part.data.size // max(1, shape[0] * shape[1])
        pixels = part.data.reshape(*shape, channels)[..., order]
        return np.ascontiguousarray(pixels, dtype=np.uint8)
    return None
