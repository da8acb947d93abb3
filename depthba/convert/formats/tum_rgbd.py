"""The TUM RGB-D benchmark: depth.txt and rgb.txt list images by stamp, groundtruth.txt has poses.

Depth images are 16 bit, 5000 steps a metre; colour is aligned to depth. The folder does not say the
intrinsics: the benchmark's site does, per camera (freiburg1, 2, 3).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import durable, trajectory
from depthba.camera import Camera
from depthba.convert import files, intrinsics, pairing, pose_files
from depthba.convert.reading import Reading
from depthba.convert.recording import Format, Recording, SourceFrame
from depthba.convert.writing import camera_of, depth_pixels, each, new_folder, write_png
from depthba.dataset import Dataset
from depthba.errors import DatasetError

Array = NDArray[np.float64]

SCALE = 1 / 5000
POSES = "groundtruth.txt"
PUBLISHED = {
    "1": Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": Camera(640, 480, 520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": Camera(640, 480, 535.4, 539.2, 320.1, 247.6),
}
"""By the digit behind "freiburg" in the folder's name."""
_ALIGNED = 0.02
"""Colour within that much of a depth image belongs to it, s, as the benchmark's own tool has it."""


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    return "depth.txt lists images by stamp" if (path / "depth.txt").is_file() else ""


def read(path: Path, reading: Reading) -> Recording:
    """Read a sequence."""
    depth = _listing(path / "depth.txt", reading)
    colour = _listing(path / "rgb.txt", reading) if (path / "rgb.txt").is_file() else []
    poses = pose_files.read(Path(reading.poses) if reading.poses else path / POSES)
    if poses.stamps is None:
        raise DatasetError(f"{poses.path}: poses without stamps, expected TUM: stamp tx … qw")
    digit = re.search(r"(?:freiburg|fr)([123])(?!\d)", path.resolve().name)
    camera = intrinsics.camera_of(
        path,
        depth[0][1],
        reading,
        PUBLISHED[digit[1]] if digit else None,
        "neither does TUM RGB-D say the intrinsics, nor is freiburg1, 2 or 3 in its name",
    )
    stamps = np.array([stamp for stamp, _ in depth])
    names = [file.name for _, file in depth]
    paired, notes = pairing.by_stamp(names, stamps, poses, reading.max_gap)
    scale = reading.depth_scale or SCALE
    frames = []
    for k, stamp, pose in paired:
        near = min(colour, key=lambda row: abs(row[0] - stamp), default=None)
        aligned = near is not None and abs(near[0] - stamp) <= _ALIGNED
        frames.append(
            SourceFrame(
                name=names[k],
                stamp=stamp,
                pose=pose,
                depth=files.depth_image(depth[k][1], scale),
                rgb=files.colour_image(near[1]) if aligned and near is not None else None,
                camera=camera,
            )
        )
    return Recording(path, "tum-rgbd", tuple(frames), depth_scale=scale, notes=notes)


def write(dataset: Dataset, T_world_camera: Array, path: Path) -> None:
    """Write a sequence; camera.json beside it says the intrinsics."""
    camera = camera_of(dataset, "TUM RGB-D")
    new_folder(path, "depth")
    lists: dict[str, list[str]] = {"depth": [], "rgb": []}
    for _, frame, _T in each(dataset, T_world_camera):
        name = f"{frame.stamp:.9f}"
        write_png(path / "depth" / f"{name}.png", depth_pixels(frame, SCALE))
        lists["depth"].append(f"{name} depth/{name}.png")
        if (rgb := frame.rgb()) is not None:
            durable.make_folder(path / "rgb")
            write_png(path / "rgb" / f"{name}.png", rgb)
            lists["rgb"].append(f"{name} rgb/{name}.png")
    for kind, lines in lists.items():
        if lines:
            head = f"# {kind} images\n# timestamp filename\n"
            durable.write_text(path / f"{kind}.txt", head + "\n".join(lines) + "\n")
    intrinsics.write_open3d(camera, path / "camera.json")
    trajectory.write_tum(path / POSES, dataset.stamps, T_world_camera)


def _listing(path: Path, reading: Reading) -> list[tuple[float, Path]]:
    """Return stamps and files of such as depth.txt."""
    out = []
    for at, line in enumerate(files.text(path).splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            stamp, name = float(words[0]), words[1]
        except (ValueError, IndexError):
            raise DatasetError(
                f"{path}: line {at}: {line[:60]!r}, expected a stamp and a file name"
            ) from None
        out.append((stamp, files.named(path.parent, name, path, reading.outside)))
    if not out:
        raise DatasetError(f"{path}: lists no image")
    return out


FORMAT = Format(
    "tum-rgbd", "TUM RGB-D: depth.txt, rgb.txt, groundtruth.txt", recognise, read, write
)
