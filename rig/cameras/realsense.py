"""RealSense cameras, on pyrealsense2.

Streams are opened sensor by sensor, so that a camera on USB, a recording and a software device
take the same road.
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

_AS_OPENCV = ("brown_conrady", "inverse_brown_conrady")
"""Distortions whose coefficients are OpenCV's k1 k2 p1 p2 k3."""
_WORST_RAY = 0.05
"""By how much the SDK's own rays may miss our camera's, px."""
_QUEUE = 4


@dataclass(frozen=True)
class RealSenseOptions:
    """Which camera, and how it measures."""

    serial: str | None = None
    """None: the only one there is."""
    width: int = 1280
    """Of the depth image, px."""
    height: int = 720
    fps: int = 15
    colour: bool = True
    """Take colour too, aligned to the depth image."""
    colour_width: int = 1280
    colour_height: int = 720
    depth_min: float | None = None
    """What the camera can measure, m. None: not known."""
    depth_max: float | None = None
    noise: tuple[float, float, float] | None = None
    """sigma_m, at_m and power of the range's standard deviation. None: not known."""


class RealSenseCamera:
    """`rig.cameras.camera.DepthCamera` on librealsense.

    Stamps: with a time in the host's clock (global or system time), that of the frame. With the
    camera's own clock alone: the arrival at the host less one frame period, the time from the
    middle of the exposure to the end of the transfer. `depth` is aligned to nothing; colour is
    aligned to it.
    """

    Options = RealSenseOptions

    def __init__(self, options: RealSenseOptions, device: Any = None):
        """Make a camera.

        Args:
            options: which and how.
            device: a `pyrealsense2.device` at hand, as a software device. None: looked for on USB.
        """
        self._options = options
        self._device = device
        self._rs: Any = None
        self._sensors: list[Any] = []
        self._syncer: Any = None
        self._align: Any = None
        self._scale = 0.0

    def open(self) -> CameraInfo:
        """Start the streams."""
        try:
            import pyrealsense2 as rs
        except ImportError as error:
            raise MissingPackage(
                "a RealSense camera needs the package pyrealsense2: pip install 'depthba[cameras]'"
            ) from error
        self.close()
        self._rs = rs
        try:
            return self._open()
        except RuntimeError as error:
            self.close()
            raise CameraError(f"realsense: {_first_line(error)}") from error
        except CameraError:
            self.close()
            raise

    def capture(self, timeout: float) -> Capture:
        """A frame whose exposure began after this call."""
        if self._syncer is None:
            raise CameraError("realsense: not open, expected open() first")
        called, deadline = time.time(), time.monotonic() + timeout
        stale = 0
        try:
            while (frames := self._syncer.poll_for_frames()) and frames.size():
                pass  # what waits was exposed before
            while (left := deadline - time.monotonic()) > 0:
                came, frames = self._syncer.try_wait_for_frames(max(1, int(1e3 * left)))
                if not came:
                    break
                depth = frames.get_depth_frame()
                if not depth or (self._options.colour and not frames.get_color_frame()):
                    continue  # the other half of the pair is still on its way
                stamp, began = self._times(depth)
                if began < called:
                    stale += 1
                    continue
                return self._frame(frames, stamp)
        except RuntimeError as error:
            raise CameraError(f"realsense: {_first_line(error)}") from error
        seen = f", only {stale} of before" if stale else ""
        raise CameraTimeout(f"realsense: no new frame within {timeout:g} s{seen}")

    def close(self) -> None:
        """Stop the streams."""
        sensors, self._sensors = self._sensors, []
        self._syncer = self._align = None
        for sensor in sensors:
            for end in (sensor.stop, sensor.close):
                try:
                    end()
                except RuntimeError:
                    continue  # it was unplugged, or had not begun

    def _open(self) -> CameraInfo:
        rs, options = self._rs, self._options
        device = self._device if self._device is not None else self._found()
        wanted = [(rs.stream.depth, rs.format.z16, options.width, options.height)]
        if options.colour:
            size = (options.colour_width, options.colour_height)
            wanted.append((rs.stream.color, rs.format.rgb8, *size))
        sensors = device.query_sensors()
        chosen = [self._profile(sensors, *stream) for stream in wanted]
        self._syncer = rs.syncer(_QUEUE)
        for sensor in sensors:
            profiles = [profile for other, profile in chosen if other is sensor]
            if not profiles:
                continue
            if sensor.supports(rs.option.global_time_enabled):
                sensor.set_option(rs.option.global_time_enabled, 1)
            sensor.open(profiles)
            self._sensors.append(sensor)
            sensor.start(self._syncer)
        depth_sensor, profile = chosen[0]
        self._scale = float(depth_sensor.get_option(rs.option.depth_units))
        self._align = rs.align(rs.stream.depth) if options.colour else None
        intrinsics = profile.as_video_stream_profile().get_intrinsics()
        camera = camera_from(
            intrinsics.width,
            intrinsics.height,
            (intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy),
            intrinsics.model.name,
            intrinsics.coeffs,
        )
        if (error := disagreement(camera, intrinsics)) > _WORST_RAY:
            raise CameraError(
                f"realsense: the SDK's rays for distortion {intrinsics.model.name} miss OpenCV's"
                f" by {error:.2f} px, expected {_WORST_RAY:g} px"
            )
        settings: dict[str, str | float | bool] = {
            "fps": float(options.fps),
            "colour": options.colour,
        }
        if firmware := self._text(device, rs.camera_info.firmware_version):
            settings["firmware"] = firmware
        return CameraInfo(
            model=self._text(device, rs.camera_info.name),
            serial=self._text(device, rs.camera_info.serial_number),
            camera=camera,
            # a float32 of the SDK: 0.001 comes as 0.0010000000475
            depth_scale=float(f"{self._scale:.6g}"),
            depth_min=options.depth_min,
            depth_max=options.depth_max,
            noise=options.noise,
            settings=settings,
        )

    def _found(self) -> Any:
        """Return the device on USB that the options name."""
        rs = self._rs
        devices = {
            self._text(device, rs.camera_info.serial_number): device
            for device in rs.context().query_devices()
        }
        wanted = self._options.serial
        there = ", ".join(devices) or "none"
        if wanted is not None and wanted not in devices:
            raise CameraError(f"realsense: no camera with serial {wanted}, there are: {there}")
        if wanted is None and len(devices) != 1:
            raise CameraError(
                f"realsense: cameras there: {there}; expected one, or the option serial"
            )
        return devices[wanted] if wanted is not None else next(iter(devices.values()))

    def _profile(
        self, sensors: Sequence[Any], stream: Any, pixel: Any, width: int, height: int
    ) -> tuple[Any, Any]:
        """Return the sensor and its profile for a stream of that size."""
        offered = set()
        for sensor in sensors:
            for profile in sensor.get_stream_profiles():
                if profile.stream_type() != stream or profile.format() != pixel:
                    continue
                video = profile.as_video_stream_profile()
                found = (video.width(), video.height(), profile.fps())
                if found == (width, height, self._options.fps):
                    return sensor, profile
                offered.add("{} x {} at {} Hz".format(*found))
        raise CameraError(
            f"realsense: no {stream.name} of {width} x {height} at {self._options.fps} Hz;"
            f" choose from: {', '.join(sorted(offered)) or 'none'}"
        )

    def _text(self, device: Any, what: Any) -> str:
        return str(device.get_info(what)) if device.supports(what) else ""

    def _times(self, depth: Any) -> tuple[float, float]:
        """Return stamp and beginning of the exposure, host clock, s."""
        rs = self._rs
        if depth.frame_timestamp_domain != rs.timestamp_domain.hardware_clock:
            stamp = depth.timestamp / 1e3
            exposure = 0.0
            if depth.supports_frame_metadata(rs.frame_metadata_value.actual_exposure):
                value = rs.frame_metadata_value.actual_exposure
                exposure = depth.get_frame_metadata(value) / 1e6
            return stamp, stamp - exposure / 2
        arrival = time.time()
        if depth.supports_frame_metadata(rs.frame_metadata_value.time_of_arrival):
            arrival = depth.get_frame_metadata(rs.frame_metadata_value.time_of_arrival) / 1e3
        period = 1 / self._options.fps
        return arrival - period, arrival - 2 * period

    def _frame(self, frames: Any, stamp: float) -> Capture:
        rgb = None
        if self._align is not None:
            frames = self._align.process(frames)
            # the SDK takes its memory back: copies
            rgb = np.array(np.asanyarray(frames.get_color_frame().get_data()), dtype=np.uint8)
        counts = np.asanyarray(frames.get_depth_frame().get_data())
        return Capture(depth_from(counts, self._scale), stamp, rgb)


def depth_from(counts: ArrayLike, scale: float) -> NDArray[np.float32]:
    """Return depth (height, width), m, of counts uint16; 0 is no measurement and becomes NaN."""
    z = np.asarray(counts)
    return np.where(z > 0, z * np.float64(scale), np.nan).astype(np.float32)


def camera_from(
    width: int,
    height: int,
    pinhole: tuple[float, float, float, float],
    model: str,
    coefficients: Sequence[float],
) -> Camera:
    """Return the camera that librealsense's intrinsics describe.

    Args:
        width: px.
        height: px.
        pinhole: fx, fy, cx, cy, px.
        model: librealsense's name of the distortion.
        coefficients: five, in its order.

    Raises:
        CameraError: a distortion that is not OpenCV's.
    """
    fx, fy, cx, cy = (float(value) for value in pinhole)
    k1, k2, p1, p2, k3 = (float(value) for value in coefficients[:5])
    if model == "none" or not any((k1, k2, p1, p2, k3)):
        return Camera(width, height, fx, fy, cx, cy)
    if model not in _AS_OPENCV:
        raise CameraError(
            f"realsense: distortion {model}, expected none or one of {', '.join(_AS_OPENCV)}"
        )
    return Camera(width, height, fx, fy, cx, cy, (k1, k2, p1, p2, k3))


def disagreement(camera: Camera, intrinsics: Any) -> float:
    """Return by how many pixels the SDK's own rays of the corners and the centre miss the camera's.

    What a model's name means has changed between releases of the SDK: the one at hand is asked.
    """
    import pyrealsense2 as rs

    w, h = camera.width - 1, camera.height - 1
    pixels = np.array([(0, 0), (w, 0), (0, h), (w, h), (w // 2, h // 2)], dtype=np.float64)
    rays = [rs.rs2_deproject_pixel_to_point(intrinsics, list(pixel), 1.0) for pixel in pixels]
    return float(np.abs(camera.project(np.array(rays)) - pixels).max())


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
