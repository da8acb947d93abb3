"""Writes realsense.bag with RealSense's own library: a depth and a colour sensor, four frames.

    python -m tests.depthba.convert.realsense_bag tests/depthba/convert/realsense.bag

takes pyrealsense2 up to 2.57: later ones record bags of ROS 2. The one beside this was written by
pyrealsense2 2.57.7, packed with LZ4 as the viewer packs its recordings.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 32, 24
LENS = (30.5, 30.25, 15.625, 11.375)
UNIT = 0.00025
"""m; not the common 0.001, so that one that is guessed would be noticed."""
FRAMES = 4
START, PERIOD = 1_700_000_000_000.0, 33.25
"""ms."""


def depth(k: int) -> NDArray[np.uint16]:
    """Return depth in units: a slope, a step, a hole and a row without values."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    z = 2000 + 40 * k + 3 * u + 5 * v + 1000 * (u > 20)
    z[0] = 0
    z[5:8, 6:10] = 0
    return z.astype(np.uint16)


def colour(k: int) -> NDArray[np.uint8]:
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.stack([8 * u, 10 * v, 0 * u + 20 * k], axis=-1).astype(np.uint8)


def stamps() -> NDArray[np.float64]:
    """Return when the frames were taken, s."""
    return (START + PERIOD * np.arange(FRAMES)) / 1000


def record(file: str) -> None:
    import pyrealsense2 as rs

    device = rs.software_device()
    told = rs.camera_info
    for what, text in ((told.name, "Software D405"), (told.serial_number, "0")):
        device.register_info(what, text)

    def stream(kind: Any, pixels: Any, uid: int, size: int) -> Any:
        made = rs.video_stream()
        made.type, made.fmt, made.uid, made.bpp, made.index = kind, pixels, uid, size, 0
        made.width, made.height, made.fps = WIDTH, HEIGHT, 30
        lens = rs.intrinsics()
        lens.width, lens.height, lens.coeffs = WIDTH, HEIGHT, [0.0] * 5
        lens.model = rs.distortion.brown_conrady  # as cameras of the D400 say it
        lens.fx, lens.fy, lens.ppx, lens.ppy = LENS
        made.intrinsics = lens
        return made

    stereo, rgb = device.add_sensor("Stereo Module"), device.add_sensor("RGB Camera")
    stereo.add_read_only_option(rs.option.depth_units, UNIT)
    profiles = (
        stereo.add_video_stream(stream(rs.stream.depth, rs.format.z16, 1, 2)),
        rgb.add_video_stream(stream(rs.stream.color, rs.format.rgb8, 2, 3)),
    )
    recorder = rs.recorder(file, device, True)
    sensors = recorder.query_sensors()
    queues = [rs.frame_queue(50) for _ in sensors]
    for sensor, profile, queue in zip(sensors, profiles, queues, strict=True):
        sensor.open(profile)
        sensor.start(queue)
    for k in range(FRAMES):
        for sensor, profile, pixels in zip(
            (stereo, rgb), profiles, (depth(k), colour(k)), strict=True
        ):
            frame = rs.software_video_frame()
            frame.pixels, frame.bpp = pixels, pixels[0, 0].nbytes
            frame.stride, frame.frame_number = WIDTH * frame.bpp, k
            frame.timestamp = START + PERIOD * k
            frame.domain = rs.timestamp_domain.global_time
            frame.profile = profile.as_video_stream_profile()
            if pixels.ndim == 2 and hasattr(frame, "depth_units"):
                frame.depth_units = UNIT
            sensor.on_video_frame(frame)
        time.sleep(0.2)  # it drops what comes too fast
    for sensor in sensors:
        sensor.stop()
        sensor.close()


if __name__ == "__main__":
    record(sys.argv[1])
