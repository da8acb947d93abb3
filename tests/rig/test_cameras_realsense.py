"""The RealSense camera on pyrealsense2's software device, which takes frames without hardware."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from depthba.camera import Camera
from rig.cameras.realsense import (
    RealSenseCamera,
    RealSenseOptions,
    camera_from,
    depth_from,
    disagreement,
)
from rig.errors import CameraError, CameraTimeout

rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 has no wheel for this platform")

WIDTH, HEIGHT, FOCAL, UNIT, BASE = 64, 48, 60.0, 0.0005, 0.1
COEFFICIENTS = [0.05, -0.02, 0.001, -0.002, 0.003]
OPTIONS = RealSenseOptions(
    width=WIDTH, height=HEIGHT, fps=30, colour_width=WIDTH, colour_height=HEIGHT
)


class Software:
    """A software device with a depth and a colour sensor, 0.1 m apart along x."""

    def __init__(self, distortion: Any, units: float = UNIT) -> None:
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Software D400")
        self.device.register_info(rs.camera_info.serial_number, "0042")
        self.sensors = [self.device.add_sensor(name) for name in ("Stereo Module", "RGB Camera")]
        kinds = (
            (rs.stream.depth, rs.format.z16, 2, distortion, COEFFICIENTS),
            (rs.stream.color, rs.format.rgb8, 3, rs.distortion.none, [0.0] * 5),
        )
        self.profiles = []
        for row, (kind, pixel, size, model, coefficients) in enumerate(kinds):
            intrinsics = rs.intrinsics()
            intrinsics.width, intrinsics.height = WIDTH, HEIGHT
            intrinsics.fx = intrinsics.fy = FOCAL
            intrinsics.ppx, intrinsics.ppy = 31.5, 23.5
            intrinsics.model, intrinsics.coeffs = model, coefficients
            stream = rs.video_stream()
            stream.type, stream.index, stream.uid, stream.fmt = kind, 0, row + 1, pixel
            stream.width, stream.height, stream.fps, stream.bpp = WIDTH, HEIGHT, 30, size
            stream.intrinsics = intrinsics
            self.profiles.append(self.sensors[row].add_video_stream(stream, True))
        self.sensors[0].add_read_only_option(rs.option.depth_units, units)
        apart = rs.extrinsics()
        apart.rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]
        apart.translation = [-BASE, 0, 0]  # p_colour = p_depth - base: it sits to the right
        self.profiles[0].register_extrinsics_to(self.profiles[1], apart)
        self.device.create_matcher(rs.matchers.default)
        self._number = 0
        self._kept: list[NDArray] = []

    def inject(self, counts: NDArray[np.uint16], rgb: NDArray[np.uint8], stamp: float, domain: Any):
        self._number += 1
        for row, (pixels, size) in enumerate(((counts, 2), (rgb, 3))):
            self._kept.append(pixels)
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = pixels, WIDTH * size, size
            frame.timestamp, frame.domain, frame.frame_number = 1e3 * stamp, domain, self._number
            frame.profile = self.profiles[row].as_video_stream_profile()
            frame.depth_units = UNIT
            self.sensors[row].on_video_frame(frame)


@contextmanager
def streaming(
    software: Software,
    lag: float = 0.0,
    domain: Any = rs.timestamp_domain.system_time,
) -> Iterator[list[float]]:
    """Inject a frame every 20 ms whose stamp is `lag` s old; yield the stamps."""
    ended = threading.Event()
    stamps: list[float] = []

    def run() -> None:
        columns = np.broadcast_to(
            np.arange(WIDTH, dtype=np.uint8)[None, :, None], (HEIGHT, WIDTH, 3)
        )
        while not ended.wait(0.02):
            counts = np.full((HEIGHT, WIDTH), 2000 + len(stamps), np.uint16)
            counts[:, :4] = 0
            stamps.append(time.time() - lag)
            software.inject(counts, np.ascontiguousarray(columns), stamps[-1], domain)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield stamps
    finally:
        ended.set()
        thread.join()


def test_depth_in_metres_and_colour_aligned_to_it() -> None:
    software = Software(rs.distortion.brown_conrady)
    camera = RealSenseCamera(OPTIONS, software.device)
    info = camera.open()
    assert (info.model, info.serial, info.depth_scale) == ("Software D400", "0042", UNIT)
    found = info.camera
    assert (found.width, found.height, found.fx, found.cx, found.cy) == (64, 48, 60.0, 31.5, 23.5)
    np.testing.assert_allclose(found.distortion, COEFFICIENTS, rtol=1e-6)
    called = time.time()
    with streaming(software) as stamps:
        captures = [camera.capture(20.0) for _ in range(3)]
    for capture in captures:
        assert capture.stamp >= called
        called = capture.stamp
        index = int(np.argmin(np.abs(np.array(stamps) - capture.stamp)))
        assert abs(stamps[index] - capture.stamp) < 1e-3
        z = UNIT * (2000 + index)
        assert np.isnan(capture.depth[:, :4]).all()
        np.testing.assert_allclose(capture.depth[:, 4:], z, rtol=1e-6)
        assert capture.rgb is not None
        assert capture.rgb.shape == (HEIGHT, WIDTH, 3)
        # each pixel's point, seen by the colour sensor: its column is written there
        point = found.rays() * z - [BASE, 0, 0]
        column = FOCAL * point[..., 0] / z + 31.5
        row = FOCAL * point[..., 1] / z + 23.5
        inside = (column > 1) & (column < WIDTH - 2) & (row > 1) & (row < HEIGHT - 2)
        inside &= ~np.isnan(capture.depth)
        assert inside.mean() > 0.5
        error = capture.rgb[..., 0][inside].astype(float) - column[inside]
        assert np.abs(error).max() < 1.6  # nearest pixel, and the SDK splats whole ones
        assert abs(np.median(error)) < 0.6
    camera.close()
    camera.close()
    with pytest.raises(CameraError, match="not open"):
        camera.capture(1.0)


def test_a_frame_of_before_the_call_is_never_given() -> None:
    software = Software(rs.distortion.none)
    camera = RealSenseCamera(OPTIONS, software.device)
    camera.open()
    with pytest.raises(CameraTimeout, match=r"no new frame within 0\.2 s"):
        camera.capture(0.2)
    lagging = pytest.raises(CameraTimeout, match=r"within 0\.5 s, only \d+ of before")
    with streaming(software, lag=100.0), lagging:  # or a clock that is off
        camera.capture(0.5)
    with streaming(software) as stamps:
        while len(stamps) < 10:
            time.sleep(0.01)
        called = time.time()
        assert camera.capture(20.0).stamp >= called
    camera.close()


def test_a_camera_with_a_clock_of_its_own_is_stamped_by_arrival() -> None:
    software = Software(rs.distortion.none)
    camera = RealSenseCamera(OPTIONS, software.device)
    camera.open()
    with streaming(software, lag=1e9, domain=rs.timestamp_domain.hardware_clock):
        called = time.time()
        stamp = camera.capture(20.0).stamp
    assert called <= stamp <= time.time()
    camera.close()


def test_says_what_the_camera_offers() -> None:
    software = Software(rs.distortion.none)
    wrong = RealSenseOptions(width=32, height=HEIGHT, fps=30)
    with pytest.raises(CameraError, match=r"no depth of 32 x 48 at 30 Hz; .*: 64 x 48 at 30 Hz"):
        RealSenseCamera(wrong, software.device).open()
    with pytest.raises(CameraError, match=r"no color of 1280 x 720 at 30 Hz; .*: 64 x 48"):
        RealSenseCamera(
            RealSenseOptions(width=WIDTH, height=HEIGHT, fps=30), software.device
        ).open()
    software = Software(rs.distortion.kannala_brandt4)
    with pytest.raises(CameraError, match="distortion kannala_brandt4, expected none"):
        RealSenseCamera(OPTIONS, software.device).open()
    with pytest.raises(CameraError, match="no camera with serial 7, there are: none"):
        RealSenseCamera(RealSenseOptions(serial="7")).open()


@pytest.mark.parametrize("model", ["brown_conrady", "inverse_brown_conrady"])
def test_the_sdks_own_rays_are_ours(model: str) -> None:
    pinhole = (380.0, 381.0, 318.0, 242.0)
    k = [-0.055, 0.066, 0.0008, 0.0006, -0.021]
    camera = camera_from(640, 480, pinhole, model, k)
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height = 640, 480
    intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy = pinhole
    intrinsics.model, intrinsics.coeffs = getattr(rs.distortion, model), k
    assert disagreement(camera, intrinsics) < 0.02
    for u, v in ((100, 400), (500, 60)):
        ray = rs.rs2_deproject_pixel_to_point(intrinsics, [u, v], 1.0)
        np.testing.assert_allclose(camera.rays()[v, u], ray, atol=2e-5)
    assert disagreement(Camera(640, 480, *pinhole), intrinsics) > 1
    assert camera_from(64, 48, pinhole, "none", k) == Camera(64, 48, *pinhole)
    assert camera_from(64, 48, pinhole, "ftheta", [0.0] * 5) == Camera(64, 48, *pinhole)


def test_counts_become_metres() -> None:
    depth = depth_from(np.array([[0, 1], [65535, 4]], np.uint16), 0.001)
    np.testing.assert_allclose(depth, [[np.nan, 0.001], [65.535, 0.004]], rtol=1e-6)
    assert depth.dtype == np.float32
