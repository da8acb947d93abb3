"""BOP, one scene: scene_camera.json with depth/ and rgb/.

Poses map world to camera (``cam_R_w2c``, ``cam_t_w2c`` in mm), depth in mm is the pixel times
``depth_scale``. Both may differ between frames, the intrinsics too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import durable, se3
from depthba.camera import Camera
from depthba.convert import files, intrinsics
from depthba.convert.reading import Reading
from depthba.convert.recording import Convention, Format, Recording, SourceFrame, left_out
from depthba.convert.writing import camera_of, depth_pixels, each, new_folder, write_png
from depthba.dataset import Dataset
from depthba.errors import DatasetError

Array = NDArray[np.float64]

FILE = "scene_camera.json"
MILLIMETRE = 0.001
CONVENTION = Convention(direction="world-to-camera", scale=MILLIMETRE)


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    return FILE if (path / FILE).is_file() else ""


def read(path: Path, reading: Reading) -> Recording:
    """Read one scene."""
    file = path / FILE
    value = files.json_object(file)
    try:
        order = sorted(value, key=int)
    except ValueError:
        raise DatasetError(f"{file}: a key is no image number: {sorted(value)[:3]}") from None
    frames, without = [], []
    scales = set()
    for key in order:
        entry, where = value[key], f"{file}: image {key}"
        found = [
            p for s in (".png", ".tif") if (p := path / "depth" / f"{int(key):06d}{s}").exists()
        ]
        if not found:
            without.append(key)
            continue
        steps = reading.depth_scale or MILLIMETRE * float(
            _numbers(entry, "depth_scale", 1, where)[0]
        )
        scales.add(steps)
        frames.append(
            SourceFrame(
                name=found[0].name,
                stamp=float(key),
                pose=se3.make(
                    _numbers(entry, "cam_R_w2c", 9, where).reshape(3, 3),
                    _numbers(entry, "cam_t_w2c", 3, where),
                ),
                depth=files.depth_image(found[0], steps),
                rgb=_colour(path, int(key)),
                camera=_camera(entry, found[0], reading, where),
            )
        )
    return Recording(
        path,
        "bop",
        tuple(frames),
        CONVENTION,
        depth_scale=min(scales, default=MILLIMETRE),
        notes=left_out(without, "no image in depth/"),
    )


def write(dataset: Dataset, T_world_camera: Array, path: Path) -> None:
    """Write one scene, depth at the dataset's own scale."""
    camera = camera_of(dataset, "BOP")
    if any(camera.distortion):
        raise DatasetError(
            f"{dataset.path}: lens distortion, which BOP cannot say: undistort first"
        )
    colour = any("rgb" in frame.files for frame in dataset)
    new_folder(path, "depth", *(("rgb",) if colour else ()))
    scale = dataset.sensor.depth_scale or MILLIMETRE
    poses = CONVENTION.undone(T_world_camera)
    cameras = {}
    for k, frame, _ in each(dataset, T_world_camera):
        write_png(path / "depth" / f"{k:06d}.png", depth_pixels(frame, scale))
        if (rgb := frame.rgb()) is not None:
            write_png(path / "rgb" / f"{k:06d}.png", rgb)
        cameras[str(k)] = {
            "cam_K": camera.matrix.ravel().tolist(),
            "depth_scale": scale / MILLIMETRE,
            "cam_R_w2c": poses[k, :3, :3].ravel().tolist(),
            "cam_t_w2c": poses[k, :3, 3].tolist(),
        }
    durable.write_json(path / FILE, cameras)


def _numbers(entry: Any, key: str, length: int, where: str) -> Array:
    try:
        values = np.array(entry[key], dtype=np.float64).ravel()
    except (KeyError, TypeError, ValueError):
        values = np.empty(0)
    if len(values) != length:
        raise DatasetError(f"{where}: {key} is missing or not {length} numbers")
    return values


def _camera(entry: Any, first: Path, reading: Reading, where: str) -> Camera:
    K = _numbers(entry, "cam_K", 9, where)
    lens = reading.intrinsics or (K[0], K[4], K[2], K[5])
    width, height = files.image_size(first)
    return intrinsics.made(width, height, lens, reading.distortion or (0.0,) * 5, where)


def _colour(path: Path, number: int) -> Any:
    for suffix in (".png", ".jpg"):
        if (image := path / "rgb" / f"{number:06d}{suffix}").is_file():
            return files.colour_image(image)
    return None


FORMAT = Format("bop", "BOP, one scene: scene_camera.json, depth/, rgb/", recognise, read, write)
