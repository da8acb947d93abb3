"""Images as PNG bytes. Depth: 16 bit, one channel, 0 = no measurement. Colour: 8 bit, RGB."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba.dataset.faults import MalformedError
from depthba.dataset.sensor import DEPTH_LARGEST, Sensor

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
_COMPRESSION = 3
"""Fixed, so that equal images give equal bytes; higher levels save little on noisy depth."""
_ROWS = 256
_ROUNDING = 1e-6
"""Share of a depth step by which depth_min and depth_max give: decimals are not exact in binary."""


def decode_depth(png: bytes, sensor: Sensor) -> NDArray[np.float32]:
    """Return depth (height, width) in metres, NaN where nothing was measured in the sensor's range.

    Raises `MalformedError` for bytes that are no 16-bit grey PNG of the sensor's size.
    """
    pixels = _decode(png, sensor, bits=16, channels="grey")
    scale = sensor.depth_scale or 1.0
    depth = np.empty(pixels.shape, np.float32)
    for rows in range(0, len(pixels), _ROWS):  # in double precision, but not all of it at once
        part = pixels[rows : rows + _ROWS]
        z = part * np.float64(scale)
        seen = part > 0
        if sensor.depth_min is not None:
            seen &= z >= sensor.depth_min - _ROUNDING * scale
        if sensor.depth_max is not None:
            seen &= z <= sensor.depth_max + _ROUNDING * scale
        with np.errstate(over="ignore"):  # more than single precision holds is infinite
            depth[rows : rows + _ROWS] = np.where(seen, z, np.nan)
    return depth


def decode_rgb(png: bytes, sensor: Sensor) -> NDArray[np.uint8]:
    """Return colour (height, width, 3), RGB.

    Raises `MalformedError` for bytes that are no 8-bit RGB PNG of the sensor's size.
    """
    bgr = _decode(png, sensor, bits=8, channels="RGB")
    return np.ascontiguousarray(bgr[..., ::-1]).astype(np.uint8, copy=False)


def encode_depth(depth: ArrayLike, sensor: Sensor) -> bytes:
    """Return the PNG of depth (height, width) in metres; NaN and 0 are no measurement.

    Raises `MalformedError` for a shape that is not the sensor's, and for a depth that does not fit
    16 bits at its scale: nothing wraps.
    """
    z = np.asarray(depth, dtype=np.float64)
    camera, scale = sensor.camera, sensor.depth_scale
    if camera is None or scale is None:
        raise MalformedError(
            f"a depth image for a sensor of kind {sensor.kind!r}, expected a cloud"
        )
    if z.shape != (camera.height, camera.width):
        raise MalformedError(
            f"depth of shape {z.shape},"
            f" expected (height, width) = ({camera.height}, {camera.width})"
        )
    with np.errstate(invalid="ignore"):
        steps = np.where(np.isnan(z) | (z == 0), 0.0, np.rint(z / scale))
    measured = ~(np.isnan(z) | (z == 0))
    misfit = measured & ~((steps >= 1) & (steps <= DEPTH_LARGEST))
    if misfit.any():
        v, u = (int(i) for i in np.argwhere(misfit)[0])
        raise MalformedError(
            f"depth {z[v, u]:g} m at pixel (u {u}, v {v}) and {int(misfit.sum()) - 1} more do not"
            f" fit 16 bits, expected {scale:g} to {DEPTH_LARGEST * scale:g} m"
            f" (depth_scale {scale:g}) or NaN"
        )
    return _encode(steps.astype(np.uint16))


def encode_rgb(rgb: ArrayLike, sensor: Sensor) -> bytes:
    """Return the PNG of colour (height, width, 3) uint8, RGB. `MalformedError`: it is not that."""
    pixels = np.asarray(rgb)
    camera = sensor.camera
    if camera is None:
        raise MalformedError(f"a colour image for a sensor of kind {sensor.kind!r}, expected none")
    if pixels.shape != (camera.height, camera.width, 3) or pixels.dtype != np.uint8:
        raise MalformedError(
            f"rgb of shape {pixels.shape} {pixels.dtype},"
            f" expected ({camera.height}, {camera.width}, 3) uint8"
        )
    return _encode(np.ascontiguousarray(pixels[..., ::-1]))


def _encode(pixels: NDArray[np.uint16] | NDArray[np.uint8]) -> bytes:
    import cv2  # slow to import, so only where images are

    written, png = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION])
    if not written:
        raise MalformedError("the image could not be written as PNG")
    return bytes(png.tobytes())


def _decode(
    png: bytes, sensor: Sensor, *, bits: int, channels: str
) -> NDArray[np.uint16] | NDArray[np.uint8]:
    """Decode what `_check` found whole, so that the decoder has nothing to print on stderr."""
    camera = sensor.camera
    if camera is None:
        raise MalformedError(f"an image of a sensor of kind {sensor.kind!r}, expected none")
    _check(png, camera.width, camera.height, bits, channels)
    import cv2

    pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    shape = (camera.height, camera.width) + ((3,) if channels == "RGB" else ())
    dtype: type = np.uint16 if bits == 16 else np.uint8
    if pixels is None or pixels.shape != shape or pixels.dtype != dtype:
        raise MalformedError("PNG that cannot be decoded")
    return np.asarray(pixels, dtype=dtype)


def png_chunks(png: bytes) -> tuple[bytes, list[bytes]]:
    """Return the header and the packed data of a PNG. `MalformedError`: it is not whole."""
    if not png.startswith(_SIGNATURE):
        raise MalformedError(f"begins with {png[:8]!r}, expected a PNG file")
    at, kind, header, packed = len(_SIGNATURE), b"", b"", []
    while kind != b"IEND":
        if at + 12 > len(png):
            raise MalformedError(f"PNG of {len(png)} bytes is cut off")
        length, kind = struct.unpack_from(">I4s", png, at)
        end = at + 12 + length
        if end > len(png):
            raise MalformedError(f"PNG of {len(png)} bytes is cut off, expected {end} or more")
        body = png[at + 8 : end - 4]
        if zlib.crc32(png[at + 4 : end - 4]) != struct.unpack_from(">I", png, end - 4)[0]:
            raise MalformedError(f"PNG chunk {kind.decode('latin-1')!r} has a wrong check sum")
        if not header:
            header = body
        if kind == b"IDAT":
            packed.append(body)
        at = end
    if len(header) != 13:
        raise MalformedError("PNG without an image header")
    return header, packed


def _check(png: bytes, width: int, height: int, bits: int, channels: str) -> None:
    """Refuse bytes that are no whole PNG of that size and type, before anything is decoded."""
    header, packed = png_chunks(png)
    found_width, found_height, found_bits, colour, *_, interlace = struct.unpack(">IIBBBBB", header)
    found = _CHANNELS.get(colour, f"colour type {colour}")
    if (found_bits, found) != (bits, channels):
        raise MalformedError(f"PNG of {found_bits} bit {found}, expected {bits} bit {channels}")
    if (found_width, found_height) != (width, height):
        raise MalformedError(
            f"PNG of {found_width} x {found_height} pixels, expected {width} x {height}"
        )
    size = height * (1 + width * bits // 8 * (3 if channels == "RGB" else 1))
    try:
        unpacked = zlib.decompressobj().decompress(b"".join(packed), size + 1)
    except zlib.error as error:
        raise MalformedError(f"PNG whose image data cannot be unpacked: {error}") from error
    if not interlace and len(unpacked) != size:
        raise MalformedError(f"PNG with {len(unpacked)} bytes of image data, expected {size}")
