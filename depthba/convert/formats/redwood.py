"""Redwood and Open3D's reconstruction system: depth/, color/ and a trajectory log.

The log has three integers, of which the first is the frame's place, and T_world_camera, m, for each
frame. Depth is in mm. Where no intrinsics lie beside it, they are those of the PrimeSense camera
that Open3D takes by default: 525 525 319.5 239.5 at 640 x 480.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera
from depthba.convert import files, intrinsics, pose_files
from depthba.convert.reading import Reading
from depthba.convert.recording import Format, Recording, SourceFrame, left_out
from depthba.convert.writing import camera_of, depth_pixels, each, new_folder, write_png
from depthba.dataset import Dataset
from depthba.errors import DatasetError

Array = NDArray[np.float64]

SCALE = 0.001
PUBLISHED = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
COLOURS = ("color", "image", "rgb")
LOGS = ("odometry.log", "trajectory.log", "scene/trajectory.log")
RATE = 30.0


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    log = _log(path)
    return f"{log.name} beside depth/" if log is not None and (path / "depth").is_dir() else ""


def read(path: Path, reading: Reading) -> Recording:
    """Read a sequence."""
    log = Path(reading.poses) if reading.poses else _log(path)
    found = files.listed(path / "depth", (".png",))
    if log is None or not found:
        raise DatasetError(f"{path}: expected images in depth/ and {LOGS[0]} or another *.log")
    poses = pose_files.read(log).poses
    places = _places(log, len(poses))
    if max(places) >= len(found):
        raise DatasetError(
            f"{log}: pose of frame {max(places)}, but depth/ holds {len(found)} images"
        )
    camera = intrinsics.camera_of(path, found[0], reading, PUBLISHED)
    colours = next((c for n in COLOURS if (c := files.listed(path / n, files.COLOUR_SUFFIXES))), [])
    notes: tuple[str, ...] = ()
    if colours and len(colours) != len(found):
        notes = (f"colour left out: {len(colours)} images for {len(found)} of depth",)
        colours = []
    scale = reading.depth_scale or SCALE
    frames = tuple(
        SourceFrame(
            name=found[k].name,
            stamp=k / RATE,
            pose=pose,
            depth=files.depth_image(found[k], scale),
            rgb=files.colour_image(colours[k]) if colours else None,
            camera=camera,
        )
        for k, pose in sorted(zip(places, poses, strict=True), key=lambda row: row[0])
    )
    without = sorted(set(range(len(found))) - set(places))
    notes += left_out((found[k].name for k in without), f"no pose in {log.name}")
    return Recording(path, "redwood", frames, depth_scale=scale, notes=notes)


def write(dataset: Dataset, T_world_camera: Array, path: Path) -> None:
    """Write depth/, color/, odometry.log and camera_intrinsic.json."""
    camera = camera_of(dataset, "Redwood")
    colour = any("rgb" in frame.files for frame in dataset)
    new_folder(path, "depth", *(("color",) if colour else ()))
    for k, frame, _ in each(dataset, T_world_camera):
        write_png(path / "depth" / f"{k:06d}.png", depth_pixels(frame, SCALE))
        if (rgb := frame.rgb()) is not None:
            write_png(path / "color" / f"{k:06d}.png", rgb)
    intrinsics.write_open3d(camera, path / "camera_intrinsic.json")
    pose_files.write_log(path / LOGS[0], T_world_camera)


def _log(path: Path) -> Path | None:
    there = [path / name for name in LOGS if (path / name).is_file()]
    return next(iter([*there, *sorted(path.glob("*.log"))]), None)


def _places(log: Path, expected: int) -> list[int]:
    """Return the place of the frame of each pose; in order where the log has matrices alone."""
    if not expected:
        raise DatasetError(f"{log}: no pose, expected a 4 x 4 matrix for each frame")
    heads = [line.split() for line in files.text(log).splitlines() if len(line.split()) == 3]
    try:
        places = [int(words[0]) for words in heads] or list(range(expected))
    except ValueError:
        raise DatasetError(f"{log}: a line of 3 that are not integers") from None
    if len(places) != expected or len(set(places)) != expected or min(places) < 0:
        raise DatasetError(
            f"{log}: {expected} matrices with {len(places)} heads, expected one each"
        )
    return places


FORMAT = Format("redwood", "Redwood, Open3D: depth/, color/, odometry.log", recognise, read, write)
