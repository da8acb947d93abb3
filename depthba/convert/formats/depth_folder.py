"""A bare folder of depth images with a file of poses; intrinsics and scale are given.

Images lie in the folder or in depth/ in it; the file of poses lies there too, or is given. Colour
images of the same names may lie in rgb/ or color/.
"""

from __future__ import annotations

from pathlib import Path

from depthba.convert import files, intrinsics, pairing, pose_files
from depthba.convert.reading import Reading
from depthba.convert.recording import Format, Recording, SourceFrame
from depthba.errors import DatasetError

COLOURS = ("rgb", "color", "colour", "image", "images")


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    found = _images(path)
    return f"{len(found)} images such as {found[0].name}" if found else ""


def read(path: Path, reading: Reading) -> Recording:
    """Read the folder."""
    found = _images(path)
    if not found:
        suffixes = " ".join(files.DEPTH_SUFFIXES)
        raise DatasetError(f"{path}: no depth images in it or in depth/, expected {suffixes}")
    if reading.depth_scale is None:
        told = reading.intrinsics or any((path / name).is_file() for name in intrinsics.NAMES)
        lens = "" if told else ", and --intrinsics FX FY CX CY of the depth images, pixels"
        raise DatasetError(
            f"{path}: a folder of images does not say the unit of depth, expected --depth-scale "
            f"METRES a step, such as 0.001 for mm{lens}"
        )
    poses = pose_files.read(Path(reading.poses) if reading.poses else _poses_in(path))
    camera = intrinsics.camera_of(path, found[0], reading)
    paired, notes = pairing.by_name(found, poses, reading.max_gap)
    scale = reading.depth_scale
    floats = found[0].suffix.lower() in (".npy", ".tif", ".tiff")
    frames = []
    for k, stamp, pose in paired:
        colours = [
            path / folder / f"{found[k].stem}{suffix}"
            for folder in COLOURS
            for suffix in files.COLOUR_SUFFIXES
        ]
        colour = next((c for c in colours if c.is_file()), None)
        frames.append(
            SourceFrame(
                name=found[k].name,
                stamp=stamp,
                pose=pose,
                depth=files.depth_image(found[k], scale, floats=floats),
                rgb=None if colour is None else files.colour_image(colour),
                camera=camera,
            )
        )
    frames.sort(key=lambda frame: frame.stamp)
    return Recording(
        path,
        "depth-folder",
        tuple(frames),
        depth_scale=scale,
        floats=floats,
        notes=(*notes, f"poses from {poses.path.name}"),
    )


def _images(path: Path) -> list[Path]:
    return files.listed(path / "depth", files.DEPTH_SUFFIXES) or files.listed(
        path, files.DEPTH_SUFFIXES
    )


def _poses_in(path: Path) -> Path:
    """Return the one TUM file in the folder, or poses.txt."""
    texts = [p for s in ("*.txt", "*.tum", "*.csv") for p in sorted(path.glob(s))]
    there = [p for p in texts if pose_files.looks_like_tum(p)]
    if not there and (path / "poses.txt").is_file():
        return path / "poses.txt"
    if len(there) != 1:
        names = ", ".join(p.name for p in there) or "none"
        raise DatasetError(
            f"{path}: files of poses in it: {names}, expected one in TUM format "
            "(stamp tx ty tz qx qy qz qw), or --poses FILE"
        )
    return there[0]


FORMAT = Format(
    "depth-folder",
    "any folder of depth images with a file of poses",
    recognise,
    read,
    generic=True,
)
