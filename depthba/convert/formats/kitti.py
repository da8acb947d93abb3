"""KITTI odometry: poses.txt of 12 numbers a line, with velodyne/*.bin or depth/*.png.

Poses are those of the left camera; calib.txt holds its projection P0 (with depth images P2, where
KITTI's depth belongs) and Tr, which maps the laser scanner's coordinates to the camera's. Depth
images have 256 steps a metre. times.txt has the stamps.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import durable, se3
from depthba.camera import Camera
from depthba.convert import files, intrinsics, pairing, pose_files
from depthba.convert.reading import Reading
from depthba.convert.recording import Format, Recording, SourceFrame
from depthba.convert.writing import depth_pixels, each, new_folder, write_png
from depthba.dataset import Dataset
from depthba.errors import DatasetError

Array = NDArray[np.float64]

SCALE = 1 / 256
POSES, TIMES, CALIB = "poses.txt", "times.txt", "calib.txt"


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    if any((path / "velodyne").glob("*.bin")):
        return "velodyne/*.bin"
    there = (path / CALIB).is_file() and (path / TIMES).is_file() and (path / "depth").is_dir()
    return f"{CALIB} and {TIMES} beside depth/" if there else ""


def read(path: Path, reading: Reading) -> Recording:
    """Read a sequence."""
    clouds = files.listed(path / "velodyne", (".bin",))
    found = clouds or files.listed(path / "depth", (".png",))
    if not found:
        raise DatasetError(f"{path}: expected velodyne/*.bin or depth/*.png")
    poses = pose_files.read(Path(reading.poses) if reading.poses else path / POSES)
    calib = _calib(path / CALIB) if (path / CALIB).is_file() else {}
    if poses.stamps is None and (path / TIMES).is_file():
        stamps = files.numbers(path / TIMES, 1).ravel()
        if len(stamps) != len(poses.poses):
            raise DatasetError(
                f"{path / TIMES}: {len(stamps)} stamps for {len(poses.poses)} poses in {poses.path}"
            )
        poses = pose_files.Poses(poses.path, poses.poses, stamps)
    paired = pairing.by_order([p.name for p in found], poses)
    if clouds:
        T_camera_sensor = calib.get("Tr")
        if T_camera_sensor is None:
            raise DatasetError(f"{path / CALIB}: no Tr, expected it: the poses are the camera's")
        unit = reading.cloud_scale or 1.0
        frames = tuple(
            SourceFrame(
                found[k].name, stamp, pose @ T_camera_sensor, cloud=partial(_points, found[k], unit)
            )
            for k, stamp, pose in paired
        )
        return Recording(path, "kitti", frames)
    camera = intrinsics.camera_of(path, found[0], reading, _camera(calib, found[0]))
    scale = reading.depth_scale or SCALE
    frames = tuple(
        SourceFrame(
            found[k].name, stamp, pose, depth=files.depth_image(found[k], scale), camera=camera
        )
        for k, stamp, pose in paired
    )
    return Recording(path, "kitti", frames, depth_scale=scale)


def write(dataset: Dataset, T_world_camera: Array, path: Path) -> None:
    """Write a sequence; clouds in the frame of the poses, so Tr is the identity."""
    camera = dataset.sensor.camera
    if camera is not None and any(camera.distortion):
        raise DatasetError(f"{dataset.path}: lens distortion, which KITTI cannot say")
    new_folder(path, "velodyne" if camera is None else "depth")
    for k, frame, _ in each(dataset, T_world_camera):
        if camera is None:
            points = frame.points()
            rows = np.column_stack([points, np.zeros(len(points))]).astype("<f4")
            durable.write_bytes(path / "velodyne" / f"{k:06d}.bin", rows.tobytes())
        else:
            write_png(path / "depth" / f"{k:06d}.png", depth_pixels(frame, SCALE))
    P = np.eye(3, 4)
    if camera is not None:
        P[:, :3] = camera.matrix
    lines = [f"{name}: {' '.join(f'{v:.17g}' for v in P.ravel())}" for name in ("P0", "P2")]
    lines.append("Tr: " + " ".join(f"{v:g}" for v in np.eye(3, 4).ravel()))
    durable.write_text(path / CALIB, "\n".join(lines) + "\n")
    durable.write_text(path / TIMES, "".join(f"{stamp:.9f}\n" for stamp in dataset.stamps))
    pose_files.write_kitti(path / POSES, T_world_camera)


def _calib(path: Path) -> dict[str, Array]:
    """Return the matrices (4, 4) of calib.txt by their names."""
    out = {}
    for at, line in enumerate(files.text(path).splitlines(), 1):
        name, _, rest = line.partition(":")
        if not rest.strip():
            continue
        try:
            values = np.array(rest.split(), dtype=np.float64)
        except ValueError:
            continue  # dates and names are in some
        if len(values) != 12:
            raise DatasetError(f"{path}: line {at}: {len(values)} numbers, expected 12")
        out[name.strip()] = np.vstack([values.reshape(3, 4), [0, 0, 0, 1]])
    if "Tr" in out and not se3.is_rigid(out["Tr"], 1e-2):
        raise DatasetError(f"{path}: Tr is no rigid transform")
    return out


def _camera(calib: dict[str, Array], first: Path) -> Camera | None:
    P = calib.get("P2", calib.get("P0"))
    if P is None:
        return None
    width, height = files.image_size(first)
    return intrinsics.made(width, height, (P[0, 0], P[1, 1], P[0, 2], P[1, 2]), (0.0,) * 5, CALIB)


def _points(path: Path, unit: float) -> Array:
    data = path.read_bytes()
    if len(data) % 16:
        raise DatasetError(f"{path}: {len(data)} bytes, expected 16 a point: x y z reflectance")
    return np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64) * unit


FORMAT = Format(
    "kitti", "KITTI odometry: poses.txt, calib.txt, velodyne/ or depth/", recognise, read, write
)
