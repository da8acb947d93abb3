"""How large what a file claims to hold may be: asked before any memory is.

A head of a few bytes can announce an image or an array of any size. Nothing here takes more memory
than twice the bytes of its file and `SPARE`, but for points that are packed, which may be
`PACKED` times their file.
"""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

SPARE = 200_000_000
"""Bytes."""
PIXELS = 16_000_000
"""Most pixels of an image, such as 4000 x 4000; decoding takes 12 bytes for each."""
PACKED = 16
"""Most bytes of packed points for a byte of their file, beside those that `SPARE` allows."""


def check_pixels(width: int, height: int) -> None:
    """Refuse an image of more than `PIXELS`. `ValueError`."""
    if width * height > PIXELS:
        raise ValueError(f"{width} x {height} pixels, expected {PIXELS} at most")


def check_image(data: bytes) -> None:
    """Refuse an image whose head says that it is larger than `PIXELS`, before it is decoded.

    Raises:
        ValueError: it is too large, or has no head.

    """
    from PIL import Image
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    try:
        if data[:2] in (b"II", b"MM"):  # of TIFF, Pillow opens fewer kinds of pixels than OpenCV
            file, tags = io.BytesIO(data), ImageFileDirectory_v2(data[:8])
            file.seek(tags.next)
            tags.load(file)
            width, height = int(tags[256]), int(tags[257])
        else:
            with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data)) as image:
                width, height = image.size
    except Image.DecompressionBombError:
        raise ValueError(f"far more pixels than the {PIXELS} that are expected at most") from None
    except Exception as error:  # a broken head fails in many ways
        raise ValueError("a head that cannot be read") from error
    check_pixels(width, height)


def check_packed(wanted: int, stored: int) -> None:
    """Refuse packed points that would be too large. `ValueError`.

    Args:
        wanted: bytes that the file announces.
        stored: bytes of the file.

    """
    most = SPARE // 5 + PACKED * stored
    if wanted > most:
        raise ValueError(f"{wanted} bytes packed into {stored}, expected {most} at most")


def read_array(data: bytes) -> NDArray[Any]:
    """Return the array that the bytes of an .npy file hold; never objects.

    Raises:
        ValueError: they hold none, or fewer numbers than their head says.

    """
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else None
        shape, _, dtype = (read or np.lib.format.read_array_header_2_0)(file)
        size = dtype.itemsize
        for length in shape:
            size *= int(length)
    except Exception as error:  # a head is Python's syntax, and fails in all its ways
        raise ValueError(f"no head of an array: {' '.join(str(error).split())}") from error
    there = len(data) - file.tell()
    if dtype.hasobject:
        raise ValueError("an array of objects, expected numbers")
    if any(type(n) is not int for n in shape) or min(shape, default=0) < 0 or size != there:
        raise ValueError(f"{there} bytes of numbers, expected {size} for the shape {shape}")
    file.seek(0)
    return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
