"""7-Scenes: frame-000000.depth.png, .color.png and .pose.txt in one folder.

Depth in mm, 65535 where there is none; poses camera-to-world, m. The published intrinsics are 585
585 320 240 at 640 x 480. The colour camera is not calibrated against the depth camera, so colour is
taken only where camera.json lies beside it, as depthba writes both.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import durable
from depthba.camera import Camera
from depthba.convert import files, intrinsics, pose_files
from depthba.convert.reading import Reading
from depthba.convert.recording import Format, Recording, SourceFrame, left_out
from depthba.convert.writing import camera_of, depth_pixels, each, new_folder, write_png
from depthba.dataset import Dataset
from depthba.errors import DatasetError
from depthba.words import count

Array = NDArray[np.float64]

SCALE = 0.001
NOTHING = 65535
PUBLISHED = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
RATE = 30.0
"""Frames a second, which the camera took; the files have no stamps."""


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    for folder in [path, *sorted(path.glob("seq-*"))]:
        if any(folder.glob("frame-*.depth.png")):
            return f"frame-*.depth.png in {folder.name}"
    return ""


def read(path: Path, reading: Reading) -> Recording:
    """Read one sequence."""
    folder = path
    if not any(path.glob("frame-*.depth.png")):
        there = [p for p in sorted(path.glob("seq-*")) if any(p.glob("frame-*.depth.png"))]
        if len(there) != 1:
            names = ", ".join(p.name for p in there) or "no frame-*.depth.png"
            raise DatasetError(f"{path}: holds {names}, expected one sequence: name its folder")
        folder = there[0]
    found = files.listed(folder, (".png",), "frame-*.depth.png")
    calibrated = any((folder / name).is_file() for name in intrinsics.NAMES)
    camera = intrinsics.camera_of(folder, found[0], reading, PUBLISHED)
    scale = reading.depth_scale or SCALE
    frames, without, colours = [], [], 0
    for k, file in enumerate(found):
        stem = file.name.removesuffix(".depth.png")
        pose = files.matrix(folder / f"{stem}.pose.txt")
        if not np.isfinite(pose).all():
            without.append(file.name)
            continue
        colour = folder / f"{stem}.color.png"
        colours += colour.is_file()
        frames.append(
            SourceFrame(
                name=file.name,
                stamp=k / RATE,
                pose=pose,
                depth=files.depth_image(file, scale, (NOTHING,)),
                rgb=files.colour_image(colour) if calibrated and colour.is_file() else None,
                camera=camera,
            )
        )
    notes = left_out(without, "pose not finite")
    if colours and not calibrated:
        notes += (f"{count(colours, 'colour image')} left out: not aligned to depth in 7-Scenes",)
    return Recording(folder, "7-scenes", tuple(frames), depth_scale=scale, notes=notes)


def write(dataset: Dataset, T_world_camera: Array, path: Path) -> None:
    """Write a sequence; camera.json beside it says the intrinsics."""
    camera = camera_of(dataset, "7-Scenes")
    new_folder(path)
    for k, frame, T in each(dataset, T_world_camera):
        stem = path / f"frame-{k:06d}"
        pixels = depth_pixels(frame, SCALE, NOTHING - 1)
        pixels[pixels == 0] = NOTHING
        write_png(stem.with_name(f"{stem.name}.depth.png"), pixels)
        if (rgb := frame.rgb()) is not None:
            write_png(stem.with_name(f"{stem.name}.color.png"), rgb)
        durable.write_text(stem.with_name(f"{stem.name}.pose.txt"), pose_files.rows(T))
    intrinsics.write_open3d(camera, path / "camera.json")


FORMAT = Format(
    "7-scenes", "7-Scenes: frame-*.depth.png with frame-*.pose.txt", recognise, read, write
)
