"""ZED cameras, on pyzed.

pyzed comes with Stereolabs' ZED SDK (its script ``get_python_api.py``) and never from a package
index. What the SDK gives is turned into ours by pure functions, which need no SDK.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba.camera import Camera
from depthba.errors import MissingPackage
from rig.cameras.camera import CameraInfo, Capture
from rig.errors import CameraError, CameraTimeout

_SCALES = {"millimeter": 1e-3, "centimeter": 1e-2, "meter": 1.0, "inch": 0.0254, "foot": 0.3048}


@dataclass(frozen=True)
class ZedOptions:
    """Which camera, and how it measures."""

    serial: int | None = None
    """None: the only one there is."""
    resolution: str = "HD1080"
    """Name in sl.RESOLUTION, as HD2K, HD1080, HD720."""
    fps: int = 15
    depth_mode: str = "NEURAL"
    """Name in sl.DEPTH_MODE."""
    confidence: int = 50
    """The SDK drops depths that it trusts less, 1 to 100; 100 keeps all."""
    depth_min: float = 0.3
    """m."""
    depth_max: float = 5.0
    colour: bool = True
    depth_scale: float = 1e-4
    """Metres per count of the stored images."""
    noise: tuple[float, float, float] | None = None
    """sigma_m, at_m and power of the range's standard deviation. None: not known."""


class ZedCamera:
    """`rig.cameras.camera.DepthCamera` on the ZED SDK.

    Depth and colour are of the rectified left image. The stamp is the SDK's time of the image, in
    the host's clock: when the image had come over USB, so after the exposure by its transfer.
    """

    Options = ZedOptions

    def __init__(self, options: ZedOptions):
        self._options = options
        self._sl: Any = None
        self._camera: Any = None

    def open(self) -> CameraInfo:
        """Start the camera."""
        try:
            import pyzed.sl as sl
        except ImportError as error:
            raise MissingPackage(
                "a ZED camera needs the package pyzed, which comes with Stereolabs' ZED SDK:"
                " install the SDK, then run its get_python_api.py with this Python"
            ) from error
        self.close()
        options = self._options
        wanted = sl.InitParameters()
        wanted.camera_resolution = _member(sl.RESOLUTION, options.resolution, "resolution")
        wanted.depth_mode = _member(sl.DEPTH_MODE, options.depth_mode, "depth_mode")
        wanted.camera_fps = options.fps
        wanted.coordinate_units = sl.UNIT.METER
        wanted.coordinate_system = sl.COORDINATE_SYSTEM.IMAGE
        wanted.depth_minimum_distance = options.depth_min
        wanted.depth_maximum_distance = options.depth_max
        if options.serial is not None:
            wanted.set_from_serial_number(options.serial)
        camera = sl.Camera()
        status = camera.open(wanted)
        if status != sl.ERROR_CODE.SUCCESS:
            camera.close()
            raise CameraError(f"zed: cannot be opened: {status}")
        self._sl, self._camera = sl, camera
        found = camera.get_camera_information()
        configuration = found.camera_configuration
        left = configuration.calibration_parameters.left_cam
        size = configuration.resolution
        return CameraInfo(
            model=str(found.camera_model),
            serial=str(found.serial_number),
            camera=camera_from(
                size.width, size.height, left.fx, left.fy, left.cx, left.cy, left.disto
            ),
            depth_scale=options.depth_scale,
            depth_min=options.depth_min,
            depth_max=options.depth_max,
            noise=options.noise,
            settings={
                "resolution": options.resolution,
                "fps": float(options.fps),
                "depth_mode": options.depth_mode,
                "confidence": float(options.confidence),
                "firmware": str(configuration.firmware_version),
                "sdk": str(camera.get_sdk_version()),
            },
        )

    def capture(self, timeout: float) -> Capture:
        """The first frame whose time lies after this call by a frame period at least."""
        if self._camera is None:
            raise CameraError("zed: not open, expected open() first")
        sl, options = self._sl, self._options
        called, deadline = time.time(), time.monotonic() + timeout
        runtime = sl.RuntimeParameters(confidence_threshold=options.confidence)
        while time.monotonic() < deadline:
            if self._camera.grab(runtime) != sl.ERROR_CODE.SUCCESS:
                time.sleep(0.005)
                continue
            taken = self._camera.get_timestamp(sl.TIME_REFERENCE.IMAGE)
            stamp = stamp_from(taken.get_nanoseconds())
            if stamp - 1 / options.fps < called:
                continue  # it may have been exposed before
            measured, seen = sl.Mat(), sl.Mat()
            self._camera.retrieve_measure(measured, sl.MEASURE.DEPTH)
            depth = depth_from(measured.get_data(), "meter")
            rgb = None
            if options.colour:
                self._camera.retrieve_image(seen, sl.VIEW.LEFT)
                rgb = rgb_from(seen.get_data())
            return Capture(depth, stamp, rgb)
        raise CameraTimeout(f"zed: no new frame within {timeout:g} s")

    def close(self) -> None:
        """Let go of the camera."""
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.close()


def depth_from(measure: ArrayLike, unit: str) -> NDArray[np.float32]:
    """Return depth (height, width), m, of the SDK's measure DEPTH.

    NaN where the SDK has NaN (occluded), +inf (too far) or -inf (too near), and where z is not
    above 0.

    Args:
        measure: (height, width) float32; or (height, width, 1), as a Mat gives it.
        unit: the SDK's coordinate unit: millimeter, centimeter, meter, inch or foot.
    """
    if unit not in _SCALES:
        raise CameraError(f"zed: unit {unit!r}, expected one of {', '.join(_SCALES)}")
    z = np.array(measure, dtype=np.float64)
    if z.ndim == 3 and z.shape[2] == 1:
        z = z[..., 0]
    if z.ndim != 2:
        raise CameraError(f"zed: depth of shape {z.shape}, expected (height, width)")
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(z) & (z > 0)
    return np.where(seen, z * _SCALES[unit], np.nan).astype(np.float32)


def rgb_from(image: ArrayLike) -> NDArray[np.uint8]:
    """Return colour (height, width, 3), RGB, of the SDK's BGRA (height, width, 4) uint8: a copy."""
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 4 or pixels.dtype != np.uint8:
        raise CameraError(
            f"zed: image of shape {pixels.shape} {pixels.dtype}, expected (height, width, 4) uint8"
        )
    return np.ascontiguousarray(pixels[..., 2::-1])


def stamp_from(nanoseconds: int) -> float:
    """Return seconds since the epoch; whole seconds first, so that a float loses least."""
    whole, rest = divmod(int(nanoseconds), 1_000_000_000)
    return whole + rest * 1e-9


def camera_from(
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    distortion: Sequence[float] = (),
) -> Camera:
    """Return the camera of the rectified left image, px.

    Rectified images have no distortion: CameraError where the SDK says another thing.
    """
    if np.any(np.asarray(distortion, dtype=np.float64)):
        raise CameraError(f"zed: rectified image with distortion {list(distortion)}, expected none")
    return Camera(int(width), int(height), float(fx), float(fy), float(cx), float(cy))


def _member(kind: Any, name: str, option: str) -> Any:
    """Return a member of one of the SDK's enumerations by its name."""
    found = getattr(kind, name, None)
    if found is None:
        choices = ", ".join(n for n in dir(kind) if n.isupper() and n != "LAST")
        raise CameraError(f"zed: {option} is {name!r}, expected one of {choices}")
    return found
