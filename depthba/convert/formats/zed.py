"""What the ZED's export of a recording leaves: depth000000.png in mm, left000000.png beside it.

The images are rectified, and their intrinsics are not in the folder (the calibration file has those
of the raw images), so they are given; the poses come from a file.
"""

from __future__ import annotations

from pathlib import Path

from depthba.convert import files, intrinsics, pairing, pose_files
from depthba.convert.reading import Reading
from depthba.convert.recording import Format, Recording, SourceFrame
from depthba.errors import DatasetError

SCALE = 0.001
POSES = ("poses.txt", "trajectory.txt", "pose.txt")
_PATTERN = "depth[0-9][0-9][0-9][0-9][0-9][0-9].png"


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    found = files.listed(path, (".png",), _PATTERN)
    return f"{found[0].name} and left*.png" if found and any(path.glob("left*.png")) else ""


def read(path: Path, reading: Reading) -> Recording:
    """Read the export."""
    found = files.listed(path, (".png",), _PATTERN)
    there = Path(reading.poses) if reading.poses else None
    there = there or next((path / name for name in POSES if (path / name).is_file()), None)
    if there is None:
        raise DatasetError(f"{path}: no {POSES[0]}, expected --poses FILE")
    poses = pose_files.read(there)
    camera = intrinsics.camera_of(
        path, found[0], reading, None, "a ZED's export does not say its intrinsics"
    )
    scale = reading.depth_scale or SCALE
    frames = []
    for k, stamp, pose in pairing.by_order([p.name for p in found], poses):
        left = path / found[k].name.replace("depth", "left")
        frames.append(
            SourceFrame(
                name=found[k].name,
                stamp=stamp,
                pose=pose,
                depth=files.depth_image(found[k], scale),
                rgb=files.colour_image(left) if left.is_file() else None,
                camera=camera,
            )
        )
    return Recording(path, "zed", tuple(frames), depth_scale=scale, model="zed")


FORMAT = Format("zed", "a ZED's export: depth000000.png, left000000.png", recognise, read)
