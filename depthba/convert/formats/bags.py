"""ROS 1 bags, ROS 2 bags and MCAP with depth images, camera_info and tf; RealSense's bags too.

16UC1 is in mm and 32FC1 in m (REP 118). Where there is no tf, as in RealSense's recordings, the
poses come from a TUM file, by stamp.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba.convert import pairing, pose_files
from depthba.convert.bags import depth_images, stores, tf
from depthba.convert.intrinsics import made
from depthba.convert.reading import Reading
from depthba.convert.recording import Format, Recording, SourceFrame, left_out
from depthba.errors import DatasetError

Array = NDArray[np.float64]

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
_SUFFIXES = (".bag", ".mcap", ".db3")
_ALIGNED = 1e-3
"""Colour within that much of a depth image was taken with it, s."""


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    if path.is_file():
        return path.name if path.suffix in _SUFFIXES else ""
    if (path / "metadata.yaml").is_file() and any(p.suffix in _SUFFIXES for p in path.iterdir()):
        return "metadata.yaml of a ROS 2 bag"
    return ""


def read(path: Path, reading: Reading) -> Recording:
    """Read one camera of a bag."""
    store = stores.opened(path)
    topic, encoding = _depth_topic(store, path, reading.depth_topic)
    unit = reading.depth_scale or _unit(store, topic, encoding, path)
    stamps, times, frame_id, first = [], [], "", None
    for _, time, message in store.messages([topic]):
        stamps.append(tf.seconds(message.header.stamp))
        times.append(time)
        frame_id = message.header.frame_id
        first = first or message
    if first is None:
        raise DatasetError(f"{path}: no message of {topic}, expected depth images")
    names = [f"{topic} at {stamp:.6f} s" for stamp in stamps]
    shape = depth_images.decode(first, unit, names[0]).shape
    if reading.intrinsics is not None:
        distortion = reading.distortion or (0.0,) * 5
        camera = made(shape[1], shape[0], reading.intrinsics, distortion, "--intrinsics")
    else:
        info = _info_topic(store, topic, path)
        told = next(iter(store.messages([info])), None)
        if told is None:
            raise DatasetError(f"{path}: no message of {info}, expected --intrinsics FX FY CX CY")
        camera = depth_images.camera(told[2], "rect" in topic, f"{path}: {info}")
    tree = tf.Tree(store, path)
    if reading.poses is not None:
        poses = pose_files.read(Path(reading.poses))
        if poses.stamps is None:
            raise DatasetError(f"{poses.path}: poses without stamps, expected TUM: stamp tx … qw")
        paired, notes = pairing.by_stamp(names, stamps, poses, reading.max_gap)
    elif tree:
        paired, notes = _from_tree(tree, frame_id, names, stamps, reading, path)
    else:
        raise DatasetError(f"{path}: no tf in it, expected --poses FILE in TUM format")
    colours = _colours(store, topic, shape)
    frames = []
    for k, stamp, pose in paired:
        frames.append(
            SourceFrame(
                name=names[k],
                stamp=stamp,
                pose=pose,
                depth=partial(_depth, store, topic, times[k], unit),
                rgb=_colour_at(store, colours, stamp),
                camera=camera,
            )
        )
    frames.sort(key=lambda frame: frame.stamp)
    return Recording(
        path,
        "ros-bag",
        tuple(frames),
        depth_scale=unit,
        floats=encoding == "32FC1",
        notes=(*notes, f"depth from {topic} ({encoding}, {unit:g} m a unit)"),
    )


def _depth_topic(store: stores.Store, path: Path, asked: str | None) -> tuple[str, str]:
    """Return the topic of depth images, and their encoding."""
    images = [topic for topic, kind in store.topics.items() if kind in IMAGES]
    if asked is not None and asked not in images:
        raise DatasetError(
            f"{path}: no images of topic {asked!r}, expected one of {', '.join(images) or 'none'}"
        )
    found = {}
    for topic in [asked] if asked is not None else images:
        message = next(iter(store.messages([topic])), None)
        encoding = "" if message is None else depth_images.encoding(message[2])
        if encoding and (encoding in depth_images.UNITS or _realsense(topic, "Depth")):
            found[topic] = encoding
    if len(found) != 1:
        there = ", ".join(found) or "none"
        raise DatasetError(
            f"{path}: topics of depth images (16UC1, 32FC1): {there}, expected one: "
            f"--depth-topic, of {', '.join(images) or 'no images at all'}"
        )
    return next(iter(found.items()))


def _realsense(topic: str, stream: str) -> bool:
    return topic.startswith("/device_") and f"/{stream}_" in topic


def _unit(store: stores.Store, topic: str, encoding: str, path: Path) -> float:
    """Return metres per unit: by the encoding; RealSense records its own."""
    if not _realsense(topic, "Depth"):
        return depth_images.UNITS[encoding]
    sensor = "/".join(topic.split("/")[:3])
    options = [f"{sensor}/option/{name}/value" for name in ("Depth_Units", "Depth Units")]
    for _, _, message in store.messages(options):
        # a decimal number in single precision, or as text in recordings of ROS 2
        return float(f"{float(message.data):.6g}")
    raise DatasetError(f"{path}: no {options[0]}, expected --depth-scale METRES")


def _info_topic(store: stores.Store, topic: str, path: Path) -> str:
    """Return the camera_info that belongs to images."""
    here = PurePosixPath(topic)
    for parent in here.parents:
        for name in ("camera_info", "info/camera_info"):
            if store.topics.get(str(parent / name)) == INFO:
                return str(parent / name)
    infos = [t for t, kind in store.topics.items() if kind == INFO]
    if len(infos) == 1:
        return infos[0]
    raise DatasetError(
        f"{path}: no camera_info beside {topic} among {', '.join(infos) or 'none'}, "
        "expected --intrinsics FX FY CX CY"
    )


def _from_tree(
    tree: tf.Tree,
    frame_id: str,
    names: list[str],
    stamps: list[float],
    reading: Reading,
    path: Path,
) -> tuple[pairing.Paired, tuple[str, ...]]:
    chain = tree.chain(frame_id, reading.fixed_frame)
    if len(stamps) > 1 and not tree.moves(chain):
        raise DatasetError(
            f"{path}: tf has {frame_id} at rest in {tree.root(chain)}, expected a camera that "
            "moves: --poses FILE in TUM format, or --fixed-frame"
        )
    paired: pairing.Paired = []
    without = []
    for k, stamp in enumerate(stamps):
        T = tree.at(chain, stamp, reading.max_gap)
        if T is None:
            without.append(names[k])
        else:
            paired.append((k, stamp, T))
    if not paired:
        raise DatasetError(
            f"{path}: tf has no {tree.root(chain)} to {frame_id} at the stamps of the images, "
            f"within {reading.max_gap:g} s on both sides"
        )
    note = f"poses of {frame_id} in {tree.root(chain)} out of tf"
    return paired, (*left_out(without, "not in tf at that time"), note)


def _colours(
    store: stores.Store, depth: str, shape: tuple[int, ...]
) -> list[tuple[float, str, int]]:
    """Return stamp, topic and time of colour images aligned to depth: of its size and its place."""
    found = []
    for topic, kind in store.topics.items():
        if kind not in IMAGES or topic == depth or _realsense(topic, "Color"):
            continue
        packed = kind != IMAGES[0]
        for k, (_, time, message) in enumerate(store.messages([topic])):
            if not depth_images.is_colour(message):
                break
            if packed:  # only its pixels say how large it is: those of the first stand for all
                if k == 0 and depth_images.colour(message, topic).shape[:2] != shape:
                    break
            elif (message.height, message.width) != shape:
                break
            found.append((tf.seconds(message.header.stamp), topic, time))
    return found


def _colour_at(store: stores.Store, colours: list[tuple[float, str, int]], stamp: float) -> Any:
    near = min(colours, key=lambda row: abs(row[0] - stamp), default=None)
    if near is None or abs(near[0] - stamp) > _ALIGNED:
        return None
    return partial(_colour, store, near[1], near[2])


def _depth(store: stores.Store, topic: str, time: int, unit: float) -> Array:
    return depth_images.decode(store.message(topic, time), unit, f"{topic} at {time} ns")


def _colour(store: stores.Store, topic: str, time: int) -> NDArray[np.uint8]:
    return depth_images.colour(store.message(topic, time), f"{topic} at {time} ns")


FORMAT = Format(
    "ros-bag", "ROS 1, ROS 2 or MCAP: depth, camera_info, tf; RealSense's .bag", recognise, read
)
