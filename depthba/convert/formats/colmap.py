"""COLMAP models as text, for what starts from them: written, not read.

Poses map world to camera; pixel centres are at half-integer coordinates, so half a pixel is added
to cx and cy. points3D.txt holds a thinned cloud of the frames, which splatting starts from.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import durable, se3
from depthba.clouds import load_clouds, thin, transform
from depthba.convert.recording import Convention, Format
from depthba.convert.writing import camera_of, each, new_folder, write_png
from depthba.dataset import Dataset

Array = NDArray[np.float64]

CONVENTION = Convention(direction="world-to-camera")
HALF = 0.5
POINTS = 100_000
"""Most points in points3D.txt."""


def recognise(path: Path) -> str:
    """Tell nothing: it is not read."""
    return ""


def write(dataset: Dataset, T_world_camera: Array, path: Path) -> None:
    """Write sparse/0/ with images/, where there are any."""
    camera = camera_of(dataset, "COLMAP")
    colour = any("rgb" in frame.files for frame in dataset)
    model = path / "sparse" / "0"
    new_folder(path, "sparse/0", *(("images",) if colour else ()))
    k1, k2, p1, p2, k3 = camera.distortion
    values = [camera.fx, camera.fy, camera.cx + HALF, camera.cy + HALF]
    kind = "PINHOLE"
    if any(camera.distortion):
        kind, values = "OPENCV", [*values, k1, k2, p1, p2]
    if k3:
        kind, values = "FULL_OPENCV", [*values, k3, 0.0, 0.0, 0.0]
    numbers = " ".join(f"{v:.17g}" for v in values)
    durable.write_text(
        model / "cameras.txt",
        "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n"
        f"1 {kind} {camera.width} {camera.height} {numbers}\n",
    )
    poses = CONVENTION.undone(T_world_camera)
    quaternions = se3.quaternion(poses)
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of points"]
    for k, frame, _ in each(dataset, T_world_camera):
        if (rgb := frame.rgb()) is not None:
            write_png(path / "images" / f"{k:06d}.png", rgb)
        x, y, z, w = quaternions[k]
        row = " ".join(f"{v:.17g}" for v in (w, x, y, z, *poses[k, :3, 3]))
        lines += [f"{k + 1} {row} 1 {k:06d}.png", ""]
    durable.write_text(model / "images.txt", "\n".join(lines) + "\n")
    durable.write_text(model / "points3D.txt", _points(dataset, T_world_camera))


def _points(dataset: Dataset, T_world_camera: Array) -> str:
    """Return a thinned cloud: its points have no track."""
    rows = []
    for cloud, T in zip(load_clouds(dataset), T_world_camera, strict=True):
        colours = cloud.colours
        grey = np.full((len(cloud.points), 3), 128)
        rows.append(
            np.column_stack([transform(T, cloud.points), grey if colours is None else colours])
        )
    everything = np.concatenate(rows)
    voxel = 1e-3
    while len(everything) > POINTS:
        everything = thin(everything, voxel)
        voxel *= 1.4
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]"]
    for k, row in enumerate(everything):
        r, g, b = np.rint(row[3:]).astype(int)
        lines.append(f"{k + 1} {row[0]:.6f} {row[1]:.6f} {row[2]:.6f} {r} {g} {b} 0")
    return "\n".join(lines) + "\n"


FORMAT = Format("colmap", "COLMAP's text model: sparse/0/, images/", recognise, write=write)
