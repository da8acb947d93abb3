"""Folders as ScanNet exports them: depth/, pose/, color/ and intrinsic/.

Depth in mm; pose/*.txt holds T_world_camera, m, and is infinite where tracking was lost.
intrinsic/intrinsic_depth.txt is of the depth images. Colour is taken where it has their size.
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

Array = NDArray[np.float64]

SCALE = 0.001
RATE = 30.0
INTRINSICS = ("intrinsic/intrinsic_depth.txt", "intrinsics_depth.txt", "intrinsic_depth.txt")


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    there = (path / "depth").is_dir() and any((path / "pose").glob("*.txt"))
    return "pose/*.txt beside depth/" if there else ""


def read(path: Path, reading: Reading) -> Recording:
    """Read a scan."""
    found = files.listed(path / "depth", (".png", ".pgm"))
    if not found:
        raise DatasetError(f"{path / 'depth'}: no image in it")
    camera = intrinsics.camera_of(
        path, found[0], reading, _published(path, found[0]), f"no {INTRINSICS[0]}"
    )
    scale = reading.depth_scale or SCALE
    frames, without = [], []
    other = 0
    for k, file in enumerate(found):
        pose_file = path / "pose" / f"{file.stem}.txt"
        pose = files.matrix(pose_file)
        if not np.isfinite(pose).all():
            without.append(pose_file.name)
            continue
        colours = [path / "color" / f"{file.stem}{s}" for s in files.COLOUR_SUFFIXES]
        colour = next((c for c in colours if c.is_file()), None)
        if colour is not None and files.image_size(colour) != (camera.width, camera.height):
            colour, other = None, other + 1
        frames.append(
            SourceFrame(
                name=file.name,
                stamp=(int(file.stem) if file.stem.isdecimal() else k) / RATE,
                pose=pose,
                depth=files.depth_image(file, scale),
                rgb=None if colour is None else files.colour_image(colour),
                camera=camera,
            )
        )
    notes = left_out(without, "pose not finite, tracking was lost")
    if other:
        notes += (f"{other} colour images left out: not of the size of the depth images",)
    return Recording(path, "scannet", tuple(frames), depth_scale=scale, notes=notes)


def write(dataset: Dataset, T_world_camera: Array, path: Path) -> None:
    """Write a scan."""
    camera = camera_of(dataset, "ScanNet")
    if any(camera.distortion):
        raise DatasetError(f"{dataset.path}: lens distortion, which ScanNet's folders cannot say")
    colour = any("rgb" in frame.files for frame in dataset)
    new_folder(path, "depth", "pose", "intrinsic", *(("color",) if colour else ()))
    for k, frame, T in each(dataset, T_world_camera):
        write_png(path / "depth" / f"{k}.png", depth_pixels(frame, SCALE))
        durable.write_text(path / "pose" / f"{k}.txt", pose_files.rows(T))
        if (rgb := frame.rgb()) is not None:
            write_png(path / "color" / f"{k}.png", rgb)
    K = np.eye(4)
    K[:3, :3] = camera.matrix
    durable.write_text(path / INTRINSICS[0], pose_files.rows(K))


def _published(path: Path, first: Path) -> Camera | None:
    file = next((path / name for name in INTRINSICS if (path / name).is_file()), None)
    if file is None:
        return None
    K = files.numbers(file, 3, 4)
    if len(K) not in (3, 4):
        raise DatasetError(f"{file}: {len(K)} rows, expected a matrix of 4x4 or 3x3")
    width, height = files.image_size(first)
    return intrinsics.made(
        width, height, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), (0.0,) * 5, str(file)
    )


FORMAT = Format("scannet", "ScanNet's folders: depth/, pose/, intrinsic/", recognise, read, write)
