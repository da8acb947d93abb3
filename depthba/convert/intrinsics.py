"""Intrinsics of foreign images: given, out of Open3D's JSON, or published with a format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from depthba import durable
from depthba.camera import Camera
from depthba.convert import files
from depthba.convert.reading import Reading
from depthba.errors import DatasetError

NAMES = ("camera_intrinsic.json", "camera.json", "intrinsic.json", "intrinsics.json")
"""Under which Open3D's tools and ours leave `PinholeCameraIntrinsic`."""

_UNLIKE, _ALIKE = 1.3, 1.1
"""Focal lengths in x and y of one camera are equal but for a few percent."""
_CENTRAL = 0.05
"""Of the image: a principal point lies that near the middle, mostly."""


def camera_of(
    path: Path, first: Path, reading: Reading, published: Camera | None = None, why: str = ""
) -> Camera:
    """Return the camera of a source.

    Args:
        path: the source, in which a file of Open3D's may lie.
        first: one of its depth images: its size is that of all.
        reading: what is given goes before all else.
        published: what the format's description says.
        why: why there is nothing published, for the error.

    Raises:
        DatasetError: nothing says how the camera sees, or what does is of another size.

    """
    width, height = files.image_size(first)
    if not width or not height:
        raise DatasetError(f"{first}: {width} x {height} pixels, expected an image")
    distortion = reading.distortion or (0.0,) * 5
    if reading.intrinsics is not None:
        camera = made(width, height, reading.intrinsics, distortion, "--intrinsics")
        if not reading.unchecked:
            _refuse_other_order(camera)
        if not (0 <= camera.cx < width and 0 <= camera.cy < height) and not reading.unchecked:
            raise DatasetError(
                f"--intrinsics: cx {camera.cx:g}, cy {camera.cy:g} lies outside of images of "
                f"{width} x {height} pixels: expected fx fy cx cy for this size, or --unchecked"
            )
        return camera
    beside = next((path / name for name in NAMES if (path / name).is_file()), None)
    known = read_open3d(beside) if beside is not None else published
    if known is None:
        raise DatasetError(
            f"{path}: {why or 'does not say the intrinsics'}, expected --intrinsics FX FY CX CY, "
            f"or {NAMES[1]} as Open3D writes it"
        )
    if (known.width, known.height) != (width, height):
        whose = beside or "the format's description"
        raise DatasetError(
            f"{first}: {width} x {height} pixels, but {whose} is for {known.width} x "
            f"{known.height}: expected --intrinsics FX FY CX CY"
        )
    if reading.distortion is not None:
        return made(width, height, pinhole(known), distortion, "--distortion")
    return known


def _refuse_other_order(camera: Camera) -> None:
    """Refuse intrinsics that look wrong as given, and right in another order.

    Raises `DatasetError`. Lenses that differ by so much between x and y, or whose centre lies so
    far off, are let pass where no other order makes them look as those of a camera do.
    """
    fx, fy, cx, cy = lens = pinhole(camera)
    given = "--intrinsics " + " ".join(f"{value:g}" for value in lens)
    ratio = max(fx, fy) / min(fx, fy)
    # fx cx fy cy, taken for fx fy cx cy: what is here called cx is fy, and fy is cx
    if ratio > _UNLIKE and max(fx, cx) < _ALIKE * min(fx, cx) and _central(camera, fy, cy):
        larger, smaller = ("fx", "fy") if fx > fy else ("fy", "fx")
        raise DatasetError(
            f"{given}: {larger} is {ratio:.2g} times {smaller}, expected fx fy cx cy, not fx cx fy "
            "cy? or --unchecked"
        )
    off = min(abs(cx / camera.width - 0.5), abs(cy / camera.height - 0.5))
    if off > 2 * _CENTRAL and _central(camera, cy, cx):
        raise DatasetError(
            f"{given}: cx {cx:g}, cy {cy:g} in images of {camera.width} x {camera.height} pixels, "
            "expected fx fy cx cy, not fx fy cy cx? or --unchecked"
        )


def _central(camera: Camera, cx: float, cy: float) -> bool:
    """Tell whether a point lies near the middle of the image, as principal points do."""
    x, y = cx / camera.width - 0.5, cy / camera.height - 0.5
    return max(abs(x), abs(y)) < _CENTRAL


def pinhole(camera: Camera) -> tuple[float, float, float, float]:
    """Return fx fy cx cy."""
    return camera.fx, camera.fy, camera.cx, camera.cy


def made(
    width: int, height: int, lens: tuple[float, ...], distortion: tuple[float, ...], name: str
) -> Camera:
    """Return a camera; `DatasetError` where the focal lengths are not above 0."""
    fx, fy, cx, cy = map(float, lens)
    if not (fx > 0 and fy > 0):
        raise DatasetError(f"{name}: fx {fx:g}, fy {fy:g}, expected both above 0")
    k1, k2, p1, p2, k3 = map(float, distortion)
    return Camera(width, height, fx, fy, cx, cy, (k1, k2, p1, p2, k3))


def read_open3d(path: Path) -> Camera:
    """Read Open3D's PinholeCameraIntrinsic: width, height, and the matrix column by column."""
    value = files.json_object(path)
    try:
        matrix = [float(v) for v in value["intrinsic_matrix"]]
        fx, _, _, _, fy, _, cx, cy, _ = matrix
        distortion = tuple(float(v) for v in value.get("distortion", (0.0,) * 5))
        size = int(value["width"]), int(value["height"])
        return made(*size, (fx, fy, cx, cy), distortion, str(path))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DatasetError(
            f"{path}: {error!r}, expected width, height and intrinsic_matrix of 9 numbers, "
            "column by column, as Open3D writes them"
        ) from error


def write_open3d(camera: Camera, path: Path) -> None:
    """Write a camera as Open3D does; with lens distortion, a key more, which Open3D ignores."""
    value: dict[str, Any] = {
        "width": camera.width,
        "height": camera.height,
        "intrinsic_matrix": [camera.fx, 0, 0, 0, camera.fy, 0, camera.cx, camera.cy, 1],
    }
    if any(camera.distortion):
        value["distortion"] = list(camera.distortion)
    durable.write_json(path, value)
