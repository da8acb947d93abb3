"""A folder of clouds, one a frame, each in its sensor's frame, with a file of poses.

E57 carries the poses in the file. Other clouds that lie in one frame already are said to with
``--poses identity``; PCD that carries its pose, with ``--poses viewpoint``.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import durable, se3, trajectory
from depthba.convert import files, pairing, pose_files
from depthba.convert.clouds import cloud_files, e57, pcd
from depthba.convert.reading import Reading
from depthba.convert.recording import Format, Recording, SourceFrame
from depthba.convert.writing import each, new_folder
from depthba.dataset import Dataset
from depthba.errors import DatasetError

Array = NDArray[np.float64]

POSES = "poses.txt"


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    found = _clouds(path)
    return f"{len(found)} clouds such as {found[0].name}" if found else ""


def read(path: Path, reading: Reading) -> Recording:
    """Read the folder, or one E57 file."""
    found = _clouds(path)
    if not found:
        raise DatasetError(f"{path}: no clouds, expected {' '.join(cloud_files.SUFFIXES)}")
    unit = reading.cloud_scale or 1.0
    root = path if path.is_dir() else path.parent
    if found[0].suffix.lower() == ".e57" and reading.poses is None:
        return _e57(root, found, unit)
    clouds = [partial(_scaled, file, unit) for file in found]
    if reading.poses == "identity":
        return _in_one_frame(root, found, clouds, unit)
    notes: tuple[str, ...] = ()
    if reading.poses == "viewpoint":
        views = [_viewpoint(file) for file in found]
        poses = pose_files.Poses(root, np.array(views), None)
    else:
        poses = pose_files.read(Path(reading.poses) if reading.poses else _poses_in(root))
        notes = (f"poses from {poses.path.name}",)
    paired, more = pairing.by_name(found, poses, reading.max_gap)
    frames = tuple(
        SourceFrame(found[k].name, stamp, pose, cloud=clouds[k]) for k, stamp, pose in paired
    )
    return Recording(root, "clouds", frames, notes=(*more, *notes, _unit(unit)))


def write(dataset: Dataset, T_world_camera: Array, path: Path, suffix: str) -> None:
    """Write a cloud for each frame, in its sensor's frame, and poses.txt in TUM format."""
    new_folder(path)
    if suffix == ".e57":
        scans = (frame.points().astype(np.float64) for frame in dataset)
        e57.write(path / "scans.e57", list(zip(scans, T_world_camera, strict=True)))
        return
    for k, frame, T in each(dataset, T_world_camera):
        points = frame.points().astype(np.float64)
        cloud_files.write(path / f"{k:06d}{suffix}", points, T_world_sensor=T)
    trajectory.write_tum(path / POSES, dataset.stamps, T_world_camera)
    durable.sync_folder(path)


def _clouds(path: Path) -> list[Path]:
    """Return the clouds in a folder, all of the suffix that most have; or the one E57 file."""
    if path.is_file():
        return [path] if path.suffix.lower() == ".e57" else []
    found = files.listed(path, cloud_files.SUFFIXES)
    suffixes = [p.suffix.lower() for p in found]
    if not suffixes:
        return []
    most = max(set(suffixes), key=suffixes.count)
    return [p for p in found if p.suffix.lower() == most]


def _poses_in(path: Path) -> Path:
    texts = [p for s in ("*.txt", "*.tum") for p in sorted(path.glob(s))]
    there = [p for p in texts if pose_files.looks_like_tum(p)] or [
        p for p in (path / POSES, path / "odometry.log") if p.is_file()
    ]
    if len(there) != 1:
        names = ", ".join(p.name for p in there) or "none"
        raise DatasetError(
            f"{path}: files of poses in it: {names}, expected one, or --poses FILE, or --poses "
            "identity where the clouds lie in one frame already"
        )
    return there[0]


def _e57(root: Path, found: list[Path], unit: float) -> Recording:
    frames: list[SourceFrame] = []
    for file in found:
        for k, T in enumerate(e57.poses(file)):
            frames.append(
                SourceFrame(
                    f"{file.name}, scan {k}",
                    float(len(frames)),
                    T,
                    cloud=partial(_scan, file, k, unit),
                )
            )
    return Recording(root, "clouds", tuple(frames), notes=(_unit(unit),))


def _in_one_frame(
    root: Path, found: list[Path], clouds: list[partial[Array]], unit: float
) -> Recording:
    """Put the frames near the points: single precision does not hold a national grid's metres."""
    first = clouds[0]()
    near = np.rint(first.mean(axis=0)) if len(first) else np.zeros(3)
    T = se3.make(np.eye(3), near)
    frames = tuple(
        SourceFrame(file.name, float(k), T, cloud=partial(_moved, cloud, near))
        for k, (file, cloud) in enumerate(zip(found, clouds, strict=True))
    )
    note = "clouds lie in one frame, where their rays begin is not known"
    return Recording(root, "clouds", frames, origin=False, notes=(note, _unit(unit)))


def _viewpoint(file: Path) -> Array:
    if file.suffix.lower() != ".pcd":
        raise DatasetError(f"{file}: no PCD, which alone has a viewpoint: expected --poses FILE")
    return pcd.parse(file.read_bytes(), str(file)).T_world_sensor


def _unit(unit: float) -> str:
    return f"coordinates of clouds taken as {unit:g} m each"


def _scaled(path: Path, unit: float) -> Array:
    return cloud_files.read(path) * unit


def _moved(cloud: partial[Array], away: Array) -> Array:
    return cloud() - away


def _scan(path: Path, scan: int, unit: float) -> Array:
    return e57.read(path, scan) * unit


def _writer(suffix: str) -> Format:
    return Format(
        f"clouds{suffix.replace('.', '-')}",
        f"a folder of {suffix[1:].upper()} clouds with their poses",
        lambda _: "",
        write=partial(write, suffix=suffix),
    )


FORMATS = (
    Format(
        "clouds",
        "a folder of PLY, PCD, XYZ, LAS, LAZ or E57 clouds with poses",
        recognise,
        read,
        generic=True,
    ),
    *(_writer(suffix) for suffix in cloud_files.SUFFIXES),
)
