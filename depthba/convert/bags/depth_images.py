"""Images and cameras out of messages. Encodings of depth are those of REP 118."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera
from depthba.convert import files, intrinsics
from depthba.errors import DatasetError

Array = NDArray[np.float64]

UNITS = {"16UC1": 0.001, "32FC1": 1.0}
"""Metres per unit by encoding: mm in integers, m in floating-point numbers."""
_DTYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_COLOURS = {"rgb8": (3, [0, 1, 2]), "bgr8": (3, [2, 1, 0]), "rgba8": (4, [0, 1, 2])} | {
    "bgra8": (4, [2, 1, 0])
}
_HEAD = 12
"""Bytes before the PNG in compressedDepth: a number, and two of the quantisation."""


def encoding(message: Any) -> str:
    """Return the encoding of an image, compressed or not; "" where it is not of depth."""
    if hasattr(message, "encoding"):
        return str(message.encoding) if message.encoding in _DTYPES else ""
    words = _words(message)
    if words[:1] == ["16UC1"] and "png" in words:
        return "16UC1"
    return words[0] if "compressedDepth" in words and words[0] in UNITS else ""


def is_colour(message: Any) -> bool:
    """Tell whether an image, packed or not, is of colour."""
    if hasattr(message, "encoding"):
        return message.encoding in _COLOURS
    words = _words(message)
    return not encoding(message) and "compressedDepth" not in words and words[:1] != ["mono8"]


def _words(message: Any) -> list[str]:
    """Return what the format of a packed image says, such as rgb8, jpeg, compressed."""
    return str(message.format).replace(";", " ").split()


def decode(message: Any, unit: float, name: str) -> Array:
    """Return depth (height, width), m, NaN where nothing was measured.

    Args:
        message: Image or CompressedImage.
        unit: metres per unit.
        name: for the `DatasetError`.

    """
    kind = encoding(message)
    if not kind:
        told = getattr(message, "encoding", getattr(message, "format", ""))
        raise DatasetError(f"{name}: encoding {told!r}, expected 16UC1 or 32FC1 of depth")
    if not hasattr(message, "encoding"):
        head = _HEAD if "compressedDepth" in _words(message) else 0
        z = _compressed(bytes(message.data), head, kind, name)
    else:
        order = ">" if message.is_bigendian else "<"
        z = _pixels(message, np.dtype(order + _DTYPES[kind]), 1, name)[..., 0].astype(np.float64)
    return np.where(np.isfinite(z) & (z > 0), z * unit, np.nan)


def colour(message: Any, name: str) -> NDArray[np.uint8]:
    """Return colour (height, width, 3), RGB."""
    if not hasattr(message, "encoding"):
        return files.colour_of(bytes(message.data), name)
    if message.encoding not in _COLOURS:
        raise DatasetError(f"{name}: encoding {message.encoding!r}, expected rgb8 or bgr8")
    channels, order = _COLOURS[message.encoding]
    pixels = _pixels(message, np.dtype(np.uint8), channels, name)
    return np.ascontiguousarray(pixels[..., order])


def camera(message: Any, rectified: bool, name: str) -> Camera:
    """Return the camera of a CameraInfo.

    Args:
        message: CameraInfo of ROS 1 or ROS 2.
        rectified: whether the images are rectified: P then holds, without distortion.
        name: for the `DatasetError`.

    """
    K = np.asarray(_either(message, "k", "K"), dtype=np.float64)
    P = np.asarray(_either(message, "p", "P"), dtype=np.float64)
    D = np.asarray(_either(message, "d", "D"), dtype=np.float64)
    lens: tuple[float, ...] = (K[0], K[4], K[2], K[5])
    distortion: tuple[float, ...] = (0.0,) * 5
    if rectified and P[0] > 0:
        lens = (P[0], P[5], P[2], P[6])
    elif D.any():
        # RealSense's inverse model is not OpenCV's; the camera's depth images have no distortion
        if message.distortion_model not in ("plumb_bob", "") or len(D) < 4:
            raise DatasetError(
                f"{name}: distortion_model {message.distortion_model!r}, expected plumb_bob: "
                "take rectified images"
            )
        distortion = tuple(float(v) for v in [*D[:5], 0.0][:5])
    size = int(message.width), int(message.height)
    return intrinsics.made(*size, lens, distortion, name)


def _either(message: Any, *names: str) -> Any:
    return next(getattr(message, name) for name in names if hasattr(message, name))


def _pixels(message: Any, dtype: np.dtype[Any], channels: int, name: str) -> NDArray[Any]:
    """Return (height, width, channels): rows may be padded."""
    data = np.asarray(message.data, dtype=np.uint8)
    width = message.width * channels * dtype.itemsize
    if message.step < width or len(data) < message.step * message.height:
        raise DatasetError(
            f"{name}: {len(data)} bytes in rows of {message.step}, expected {message.height} rows "
            f"of {width}"
        )
    rows = data[: message.step * message.height].reshape(message.height, message.step)[:, :width]
    return np.ascontiguousarray(rows).view(dtype).reshape(message.height, message.width, channels)


def _compressed(data: bytes, head: int, kind: str, name: str) -> Array:
    """Unpack depth behind a head; floating-point depth comes as a / (pixel - b)."""
    import cv2

    what = f"a PNG behind {head} bytes"
    pixels = files.decoded(data[head:], cv2.IMREAD_UNCHANGED, name, what)
    if pixels.ndim != 2 or pixels.dtype != np.uint16:
        raise DatasetError(f"{name}: {pixels.dtype} of shape {pixels.shape}, expected 16-bit depth")
    z = np.asarray(pixels, dtype=np.float64)
    if kind == "16UC1":
        return z
    _, a, b = struct.unpack_from("<iff", data)
    return np.where(z > 0, a / np.where(z > 0, z - b, 1.0), np.nan)
