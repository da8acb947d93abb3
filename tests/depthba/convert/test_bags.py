"""Bags as rosbags and mcap write them."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from depthba import se3
from depthba.convert import Reading, importing
from depthba.errors import DatasetError
from tests.depthba.convert import small_scene
from tests.depthba.convert.small_scene import LENS, millimetres, poses

typesys = pytest.importorskip("rosbags.typesys")
T_BODY_CAMERA = se3.make(se3.exp_so3([0.1, -0.7, 1.2]), [0.02, 0.03, -0.05])
DEPTH, INFO, COLOUR = "/camera/depth/image_raw", "/camera/depth/camera_info", "/camera/rgb/image"
PACKED = "sensor_msgs/msg/CompressedImage"


def types(ros1: bool) -> Any:
    stores = typesys.Stores
    store = typesys.get_typestore(stores.ROS1_NOETIC if ros1 else stores.ROS2_HUMBLE)
    name, text = "tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped[] transforms"
    if name not in store.types:
        store.register(typesys.get_types_from_msg(text, name))
    return store


def messages(
    store: Any, ros1: bool, encoding: str, packed: str = ""
) -> list[tuple[str, str, int, Any]]:
    """Return topic, type, time and message: tf around the images, which may be packed."""
    kinds = store.types
    out = []

    def header(stamp: float, frame: str) -> Any:
        whole = int(stamp)
        moment = kinds["builtin_interfaces/msg/Time"](
            sec=whole, nanosec=round((stamp - whole) * 1e9)
        )
        more = {"seq": 0} if ros1 else {}
        return kinds["std_msgs/msg/Header"](stamp=moment, frame_id=frame, **more)

    def tf(stamp: float, parent: str, child: str, T: Any) -> Any:
        x, y, z, w = se3.quaternion(T)
        transform = kinds["geometry_msgs/msg/Transform"](
            translation=kinds["geometry_msgs/msg/Vector3"](*T[:3, 3]),
            rotation=kinds["geometry_msgs/msg/Quaternion"](x, y, z, w),
        )
        stamped = kinds["geometry_msgs/msg/TransformStamped"](
            header(stamp, parent), child, transform
        )
        return kinds["tf2_msgs/msg/TFMessage"]([stamped])

    fixed = tf(100.0, "body", "camera_optical", T_BODY_CAMERA)
    out.append(("/tf_static", "tf2_msgs/msg/TFMessage", 0, fixed))
    lens = np.array([LENS[0], 0, LENS[2], 0, LENS[1], LENS[3], 0, 0, 1.0])
    names = ("D", "K", "R", "P") if ros1 else ("d", "k", "r", "p")
    values = (np.zeros(5), lens, np.eye(3).ravel(), np.insert(lens, [3, 6, 9], 0.0))

    def info(stamp: float) -> Any:
        return kinds["sensor_msgs/msg/CameraInfo"](
            header=header(stamp, "camera_optical"), height=60, width=80,
            distortion_model="plumb_bob", binning_x=0, binning_y=0,
            roi=kinds["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
            **dict(zip(names, values, strict=True)),
        )  # fmt: skip

    for k, T in enumerate(poses()):
        stamp, now = 100.0 + 0.5 * k, int((100 + 0.5 * k) * 1e9)
        T_world_body = T @ se3.inverse(T_BODY_CAMERA)
        # the body stands still while the shutter is open
        for before in (-0.02, 0.02):
            moved = tf(stamp + before, "world", "body", T_world_body)
            out.append(("/tf", "tf2_msgs/msg/TFMessage", now + int(before * 1e9), moved))
        pixels = millimetres(T) if encoding == "16UC1" else small_scene.depth(T).astype(np.float32)
        if packed:
            image = packed_depth(pixels, packed)
            image = kinds[PACKED](header(stamp, "camera_optical"), *image)
            out.append((DEPTH, PACKED, now, image))
            done, rgb = cv2.imencode(".png", small_scene.colour(k)[..., ::-1])
            assert done
            rgb = kinds[PACKED](header(stamp, "camera_optical"), "rgb8; png compressed bgr8", rgb)
            out.append((COLOUR, PACKED, now + 1, rgb))
            out.append((INFO, "sensor_msgs/msg/CameraInfo", now, info(stamp)))
            continue
        image = kinds["sensor_msgs/msg/Image"](
            header(stamp, "camera_optical"), 60, 80, encoding, 0, 80 * pixels.itemsize,
            pixels.view(np.uint8).ravel(),
        )  # fmt: skip
        out.append((DEPTH, "sensor_msgs/msg/Image", now, image))
        rgb = kinds["sensor_msgs/msg/Image"](
            header(stamp, "camera_optical"), 60, 80, "rgb8", 0, 240, small_scene.colour(k).ravel()
        )
        out.append((COLOUR, "sensor_msgs/msg/Image", now + 1, rgb))
        out.append((INFO, "sensor_msgs/msg/CameraInfo", now, info(stamp)))
    return out


def packed_depth(pixels: Any, how: str) -> tuple[str, Any]:
    """Return format and data of depth as image_transport's plugins pack it."""
    head = b""
    if pixels.dtype == np.float32:  # in steps of 1 / z, by a and b in the head
        a, b = 2000.0, 1.0
        head = struct.pack("<iff", 0, a, b)
        safe = np.where(np.isfinite(pixels), pixels, np.inf)
        pixels = np.where(np.isfinite(pixels), np.rint(a / safe + b), 0).astype(np.uint16)
    elif "compressedDepth" in how:
        head = bytes(12)
    done, image = cv2.imencode(".png", pixels)
    assert done
    return how, np.frombuffer(head + image.tobytes(), np.uint8)


def ros1(path: Path) -> Path:
    from rosbags.rosbag1 import Writer

    store = types(True)
    with Writer(path / "some.bag") as writer:
        made: dict[str, Any] = {}
        for topic, kind, now, message in messages(store, True, "16UC1"):
            made.setdefault(topic, None)
            if made[topic] is None:
                made[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(made[topic], max(now, 1), store.serialize_ros1(message, kind))
    return path / "some.bag"


def ros2(path: Path, plugin: str = "SQLITE3", encoding: str = "32FC1", packed: str = "") -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer

    store = types(False)
    with Writer(path / "some", version=9, storage_plugin=StoragePlugin[plugin]) as writer:
        made: dict[str, Any] = {}
        for topic, kind, now, message in messages(store, False, encoding, packed):
            if topic not in made:
                made[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(made[topic], max(now, 1), store.serialize_cdr(message, kind))
    return path / "some"


def ros2_mcap(path: Path) -> Path:
    return ros2(path, "MCAP", "16UC1")


def mcap(path: Path) -> Path:
    return packed(path, False)


def mcap_of_ros1(path: Path) -> Path:
    return packed(path, True)


def packed(path: Path, ros1: bool) -> Path:
    writing = pytest.importorskip("mcap.writer")
    store = types(ros1)
    with (path / "some.mcap").open("wb") as file:
        writer = writing.Writer(file)
        writer.start()
        made: dict[str, int] = {}
        for topic, kind, now, message in messages(store, ros1, "16UC1"):
            if topic not in made:
                text = store.generate_msgdef(kind, ros_version=1 if ros1 else 2)[0].encode()
                name = kind.replace("/msg/", "/") if ros1 else kind
                schema = writer.register_schema(name, "ros1msg" if ros1 else "ros2msg", text)
                made[topic] = writer.register_channel(topic, "ros1" if ros1 else "cdr", schema)
            data = (store.serialize_ros1 if ros1 else store.serialize_cdr)(message, kind)
            writer.add_message(made[topic], max(now, 1), bytes(data), max(now, 1))
        writer.finish()
    return path / "some.mcap"


@pytest.mark.parametrize("write", [ros1, ros2, ros2_mcap, mcap, mcap_of_ros1])
def test_bags_give_poses_out_of_tf_and_depth_by_its_encoding(
    write: Callable[[Path], Path], tmp_path: Path
) -> None:
    path = write(tmp_path)
    recording = importing.read(path, Reading())
    assert recording.format == "ros-bag"
    assert_allclose(recording.T_world_camera, poses(), rtol=0, atol=1e-9)
    assert_allclose([frame.stamp for frame in recording.frames], 100 + 0.5 * np.arange(6))
    assert any("poses of camera_optical in world out of tf" in note for note in recording.notes)
    frame = recording.frames[4]
    assert frame.camera is not None and frame.depth is not None and frame.rgb is not None
    assert (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy) == LENS
    assert_allclose(frame.depth(), small_scene.depth(poses()[4]), atol=1e-6)
    assert (frame.rgb() == small_scene.colour(4)).all()
    if write is ros2:  # floating-point depth: a step is chosen, and said
        imported = importing.into_dataset(recording, tmp_path / "out", Reading())
        assert imported.dataset.sensor.depth_scale == 1e-4
        assert "depth kept in steps of 0.0001 m" in imported.notes
        assert_allclose(imported.dataset[1].depth(), small_scene.depth(poses()[1]), atol=5.1e-5)
    with pytest.raises(DatasetError, match="no images of topic '/other', expected one of /camera"):
        importing.read(path, Reading(depth_topic="/other"))
    with pytest.raises(DatasetError, match="'camera_optical' is not below moon in the tree of"):
        importing.read(path, Reading(fixed_frame="moon"))


@pytest.mark.parametrize(
    ("encoding", "packed", "loose"),
    [
        ("16UC1", "16UC1; png compressed ", 1e-9),
        ("16UC1", "16UC1; compressedDepth png", 1e-9),
        ("32FC1", "32FC1; compressedDepth", 5e-4),  # z * z / (2 a), at 1 m
    ],
)
def test_packed_images_are_unpacked(
    encoding: str, packed: str, loose: float, tmp_path: Path
) -> None:
    recording = importing.read(ros2(tmp_path, "SQLITE3", encoding, packed), Reading())
    assert_allclose(recording.T_world_camera, poses(), rtol=0, atol=1e-9)
    frame = recording.frames[4]
    assert frame.depth is not None and frame.rgb is not None
    assert_allclose(frame.depth(), small_scene.depth(poses()[4]), rtol=0, atol=loose)
    assert (frame.rgb() == small_scene.colour(4)).all()


def test_what_is_no_bag_is_refused_in_a_line(tmp_path: Path) -> None:
    for name in ("broken.bag", "broken.mcap", "broken.db3"):
        (tmp_path / name).write_bytes(b"no bag at all" * 10)
        with pytest.raises(DatasetError, match=f"{name}: .*expected a") as caught:
            importing.read(tmp_path / name, Reading())
        assert "\n" not in str(caught.value)
