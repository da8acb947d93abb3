"""Recordings as RealSense's own library writes them: bags of ROS 1 up to 2.57, of ROS 2 after."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from depthba import Dataset, cli
from depthba.convert import Reading, importing
from depthba.convert.bags import stores
from depthba.errors import DatasetError
from depthba.trajectory import write_tum
from tests.depthba.convert import realsense_bag, small_scene
from tests.depthba.convert.small_scene import LENS, millimetres, poses

pytest.importorskip("rosbags.typesys")
BAG = Path(__file__).with_name("realsense.bag")
"""Written by realsense_bag.py."""


def wanted(k: int) -> np.ndarray:
    """Return the depth of frame k of the bag, m."""
    z = realsense_bag.depth(k).astype(np.float64)
    return np.where(z > 0, z * realsense_bag.UNIT, np.nan)


def test_a_bag_of_ros_1_keeps_depth_lens_unit_and_stamps(tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    write_tum(file, realsense_bag.stamps(), poses(4))
    recording = importing.read(BAG, Reading(poses=str(file), unchecked=True))
    assert recording.format == "ros-bag"
    assert recording.depth_scale == realsense_bag.UNIT
    assert_array_equal([frame.stamp for frame in recording.frames], realsense_bag.stamps())
    for k, frame in enumerate(recording.frames):
        camera = frame.camera
        assert camera is not None and frame.depth is not None
        assert (camera.width, camera.height) == (realsense_bag.WIDTH, realsense_bag.HEIGHT)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == realsense_bag.LENS
        assert not np.any(camera.distortion)
        assert_array_equal(frame.depth(), wanted(k))
        assert frame.rgb is None  # of another camera: not aligned to depth


def test_a_bag_of_ros_1_becomes_a_dataset_of_the_same_numbers(tmp_path: Path) -> None:
    file, out = tmp_path / "poses.txt", tmp_path / "out"
    write_tum(file, realsense_bag.stamps(), poses(4))
    words = ["convert", str(BAG), str(out), "--poses", str(file), "--unchecked"]
    assert cli.main(words) == 0
    dataset = Dataset.open(out)
    sensor = dataset.sensor
    assert sensor.depth_scale == realsense_bag.UNIT
    assert sensor.camera is not None
    assert (sensor.camera.fx, sensor.camera.fy, sensor.camera.cx, sensor.camera.cy) == (
        realsense_bag.LENS
    )
    assert len(dataset) == realsense_bag.FRAMES
    for k, frame in enumerate(dataset):
        assert frame.stamp == realsense_bag.stamps()[k]
        assert_array_equal(frame.depth(), wanted(k).astype(np.float32))


def test_a_bag_of_ros_1_says_that_poses_are_missing() -> None:
    with pytest.raises(DatasetError, match=r"realsense\.bag: no tf in it, expected --poses FILE"):
        importing.read(BAG, Reading())


def test_an_image_that_is_not_whole_is_refused() -> None:
    store = stores.opened(BAG)
    topic = "/device_0/sensor_0/Depth_0/image/data"
    reader, decoded = store._reader, store._decoded  # type: ignore[attr-defined]
    (connection,) = [c for c in reader.connections if c.topic == topic]
    _, _, data = next(iter(reader.messages([connection])))
    for whole in (data, data[:-4]):  # early versions left nothing behind the pixels
        assert decoded(connection.msgtype, whole, topic).encoding == "mono16"
    for wrong in (data[:-5], data[:-8], data + b"1234", data[:40]):
        with pytest.raises(DatasetError, match=r"Depth_0/image/data: .*expected sensor_msgs"):
            decoded(connection.msgtype, wrong, topic)


def test_a_realsense_recording_takes_its_poses_from_a_file(tmp_path: Path) -> None:
    rs = pytest.importorskip("pyrealsense2")
    path = tmp_path / "recorded.db3"
    device = rs.software_device()
    stereo = device.add_sensor("Stereo")
    stream = rs.video_stream()
    stream.type, stream.fmt, stream.uid, stream.bpp = rs.stream.depth, rs.format.z16, 1, 2
    stream.width, stream.height, stream.fps = 80, 60, 30
    lens = rs.intrinsics()
    lens.width, lens.height, lens.model, lens.coeffs = 80, 60, rs.distortion.none, [0.0] * 5
    lens.fx, lens.fy, lens.ppx, lens.ppy = LENS
    stream.intrinsics = lens
    profile = stereo.add_video_stream(stream)
    stereo.add_read_only_option(rs.option.depth_units, 0.0005)
    try:
        recorder = rs.recorder(str(path), device)
    except RuntimeError as error:
        pytest.skip(f"this version records other files: {error}")
    sensor = recorder.query_sensors()[0]
    sensor.open(profile)
    sensor.start(rs.frame_queue(10))
    for k, T in enumerate(poses()):
        frame = rs.software_video_frame()
        frame.pixels = millimetres(T, 0.0005)
        frame.stride, frame.bpp, frame.frame_number, frame.timestamp = 160, 2, k, 1000.0 * k
        frame.profile, frame.depth_units = profile.as_video_stream_profile(), 0.0005
        frame.domain = rs.timestamp_domain.hardware_clock
        stereo.on_video_frame(frame)
        time.sleep(0.03)  # it drops what comes too fast
    sensor.stop()
    sensor.close()
    del sensor, recorder
    with pytest.raises(DatasetError, match=r"at rest in .*--poses FILE in TUM format"):
        importing.read(path, Reading())
    lasting = tmp_path / "poses.txt"
    write_tum(lasting, np.array([-1.0, 100.0]), np.tile(np.eye(4), (2, 1, 1)))
    recording = importing.read(path, Reading(poses=str(lasting), max_gap=200.0, unchecked=True))
    assert recording.depth_scale == 0.0005
    assert len(recording.frames) >= 2
    depths = [frame.depth() for frame in recording.frames if frame.depth is not None]
    taken = [small_scene.depth(T) for T in poses()]
    for z in depths:
        assert min(float(np.nanmax(np.abs(z - want))) for want in taken) < 1e-9
