"""Targets of `depthba convert`: every reader, begun with what the project's own writers write."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz import mutating
from tests.fuzz.mutating import Mutator
from tests.fuzz.targets import Target, depth_set

FRAMES = 3


def _written(kind: str, file: str, path: Path) -> None:
    """Write a source of a format, `file` a valid one in it."""
    from depthba.convert import registry
    from depthba.dataset import Dataset

    depth_set(path.with_name(f"{path.name}-set"), FRAMES)
    dataset = Dataset.open(path.with_name(f"{path.name}-set"))
    write = registry.named(kind).write
    assert write is not None
    write(dataset, dataset.T_world_camera_measured, path)
    assert (path / file).is_file(), f"no {file} in {sorted(path.rglob('*'))}"


def read(path: Path, **more: Any) -> None:
    """Read a source and load its first frames."""
    from depthba.convert import Reading, importing

    kind = more.pop("kind", None)
    recording = importing.read(path, Reading(kind=kind, **more))
    for frame in itertools.islice(recording.frames, 3):
        for load in (frame.depth, frame.cloud, frame.rgb):
            if load is not None:
                load()


def _convert(name: str, kind: str, file: str, mutate: Mutator, **more: Any) -> Target:
    make = partial(_written, kind, file)
    reader = partial(read, kind=more.pop("read_as", kind), **more)
    return Target(f"convert-{name}", make, file, reader, mutate)


def _clouds(suffix: str, mutate: Mutator, file: str | None = None) -> Target:
    return _convert(
        suffix[1:], f"clouds{suffix.replace('.', '-')}", file or f"000000{suffix}", mutate,
        read_as="clouds",
    )  # fmt: skip


def _images(suffix: str, path: Path) -> None:
    """A folder of depth images of a kind that the project does not write."""
    import cv2

    from depthba.convert import pose_files

    path.mkdir()
    steps = (1000 + 10 * np.arange(48).reshape(6, 8)).astype(np.uint16)
    for k in range(FRAMES):
        file = path / f"{k:06d}{suffix}"
        if suffix == ".npy":
            np.save(file, steps.astype(np.float32))
        else:
            assert cv2.imwrite(str(file), steps.astype(np.float32) if suffix == ".tif" else steps)
    (path / "rgb").mkdir()
    cv2.imwrite(str(path / "rgb" / "000000.jpg"), np.full((6, 8, 3), 90, np.uint8))
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[:, 0, 3] = 0.1 * np.arange(FRAMES)
    pose_files.write_kitti(path / "poses.txt", T)


def _folder(name: str, suffix: str, file: str, mutate: Mutator) -> Target:
    reader = partial(read, kind="depth-folder", intrinsics=(7.0, 7.0, 4.0, 3.0), depth_scale=0.001)
    return Target(f"convert-{name}", partial(_images, suffix), file, reader, mutate)


def _bag(writer: str, path: Path) -> None:
    from tests.depthba.convert import test_bags

    path.mkdir()
    getattr(test_bags, writer)(path)


def _read_bag(file: str, path: Path) -> None:
    read(path / file, kind="ros-bag")


def _bags(name: str, writer: str, source: str, file: str, mutate: Mutator) -> Target:
    make: Callable[[Path], object] = partial(_bag, writer)
    return Target(f"convert-{name}", make, file, partial(_read_bag, source), mutate)


def _sens(path: Path) -> None:
    from tests.depthba.convert import sens_file

    path.mkdir()
    sens_file.write(path / "scan.sens", sens_file.ZLIB)


def _text_ply(path: Path) -> None:
    from depthba import trajectory

    path.mkdir()
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    body = "property float z\nend_header\n0 0 1\n1 0 1\n0 1 1\n"
    for k in range(2):
        (path / f"{k:06d}.ply").write_text(head + body)
    trajectory.write_tum(path / "poses.txt", [0.0, 1.0], np.tile(np.eye(4), (2, 1, 1)))


def _compressed_pcd(path: Path) -> None:
    """Clouds whose data are packed by literals alone, which is LZF too."""
    from depthba import trajectory

    path.mkdir()
    columns = np.arange(30, dtype="<f4").reshape(3, 10).tobytes()
    packed = b"".join(
        bytes([min(32, len(columns) - k) - 1]) + columns[k : k + 32]
        for k in range(0, len(columns), 32)
    )
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 10\n"
    head += "HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 10\nDATA binary_compressed\n"
    sizes = np.array([len(packed), len(columns)], "<u4").tobytes()
    for k in range(2):
        (path / f"{k:06d}.pcd").write_bytes(head.encode() + sizes + packed)
    trajectory.write_tum(path / "poses.txt", [0.0, 1.0], np.tile(np.eye(4), (2, 1, 1)))


_json, _text, _png, _any = mutating.of_json, mutating.of_text, mutating.of_png, mutating.of_bytes
_cloud_files = partial(read, kind="clouds")

TARGETS = (
    _convert("tum-list", "tum-rgbd", "depth.txt", _text),
    _convert("tum-colours", "tum-rgbd", "rgb.txt", _text),
    _convert("tum-poses", "tum-rgbd", "groundtruth.txt", _text),
    _convert("tum-camera", "tum-rgbd", "camera.json", _json),
    _convert("7-scenes-pose", "7-scenes", "frame-000001.pose.txt", _text),
    _convert("7-scenes-depth", "7-scenes", "frame-000000.depth.png", _png),
    _convert("7-scenes-colour", "7-scenes", "frame-000000.color.png", _png),
    _convert("redwood-log", "redwood", "odometry.log", _text),
    _convert("nerfstudio", "nerfstudio", "transforms.json", _json),
    _convert("bop", "bop", "scene_camera.json", _json),
    _convert("scannet-intrinsics", "scannet", "intrinsic/intrinsic_depth.txt", _text),
    Target("convert-sens", _sens, "scan.sens", partial(read, kind="sens"), _any),
    _convert("kitti-calib", "kitti", "calib.txt", _text),
    _convert("kitti-times", "kitti", "times.txt", _text),
    _convert("kitti-poses", "kitti", "poses.txt", _text),
    _clouds(".ply", mutating.of_ply),
    Target("convert-ply-text", _text_ply, "000000.ply", _cloud_files, mutating.of_ply),
    _clouds(".pcd", mutating.of_ply),
    Target("convert-pcd-packed", _compressed_pcd, "000000.pcd", _cloud_files, mutating.of_ply),
    _clouds(".xyz", _text),
    _clouds(".las", _any),
    _clouds(".laz", _any),
    _clouds(".e57", _any, "scans.e57"),
    _folder("pgm", ".pgm", "000000.pgm", _any),
    _folder("tif", ".tif", "000000.tif", _any),
    _folder("npy", ".npy", "000000.npy", mutating.of_npy),
    _folder("jpg", ".png", "rgb/000000.jpg", _any),
    _bags("bag-ros1", "ros1", "some.bag", "some.bag", _any),
    _bags("bag-ros2", "ros2", "some", "some/some.db3", _any),
    _bags("bag-metadata", "ros2", "some", "some/metadata.yaml", mutating.of_yaml),
    _bags("bag-mcap", "mcap", "some.mcap", "some.mcap", _any),
)
