"""nerfstudio: transforms.json, with camera-to-world poses in OpenGL's axes.

Depth images (``depth_file_path``) are integers of 0.001 m a step unless told otherwise. Pixel
centres are at half-integer coordinates there, so half a pixel is taken off cx and cy.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import durable
from depthba.camera import Camera
from depthba.convert import files, intrinsics
from depthba.convert.reading import Reading
from depthba.convert.recording import Convention, Format, Recording, SourceFrame, left_out
from depthba.convert.writing import camera_of, depth_pixels, each, new_folder, write_png
from depthba.dataset import Dataset
from depthba.dataset.fields import shown
from depthba.errors import DatasetError

Array = NDArray[np.float64]

FILE = "transforms.json"
SCALE = 0.001
CONVENTION = Convention(axes="opengl")
HALF = 0.5
"""A pixel's centre there, less its centre here."""
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def recognise(path: Path) -> str:
    """Tell what speaks for the format."""
    if path.name == FILE and path.is_file():
        return path.name
    return FILE if (path / FILE).is_file() else ""


def read(path: Path, reading: Reading) -> Recording:
    """Read transforms.json and the images it names."""
    file = path if path.is_file() else path / FILE
    root, value = file.parent, files.json_object(file)
    raw = value.get("frames")
    if not isinstance(raw, list) or not raw:
        raise DatasetError(f"{file}: no frames in it, expected a list")
    scale = reading.depth_scale or _number(value, "depth_unit_scale_factor", SCALE, file)
    frames, without = [], []
    cameras: dict[tuple[float, ...], Camera] = {}
    for k, entry in enumerate(raw):
        if not isinstance(entry, dict):
            raise DatasetError(f"{file}: frames[{k}] is {str(entry)[:60]!r}, expected an object")
        name = str(entry.get("file_path", f"frames[{k}]"))
        if not entry.get("depth_file_path"):
            without.append(name)
            continue
        depth = files.named(root, str(entry["depth_file_path"]), file, reading.outside)
        size = files.image_size(depth) if not cameras or "w" in entry else None
        colour = files.named(root, name, file, reading.outside)
        frames.append(
            SourceFrame(
                name=depth.name,
                stamp=_stamp(entry.get("timestamp", k), f"{file}: frames[{k}]"),
                pose=_pose(entry, f"{file}: frames[{k}]"),
                depth=files.depth_image(depth, scale, floats=depth.suffix == ".npy"),
                rgb=files.colour_image(colour) if colour.is_file() and colour != depth else None,
                camera=_camera({**value, **entry}, size, reading, str(file), cameras),
            )
        )
    if not frames:
        raise DatasetError(f"{file}: no frame has depth_file_path, expected depth images")
    frames.sort(key=lambda frame: frame.stamp)
    floats = any(frame.name.endswith(".npy") for frame in frames)
    return Recording(
        root,
        "nerfstudio",
        tuple(frames),
        CONVENTION,
        depth_scale=scale,
        floats=floats,
        notes=left_out(without, "no depth_file_path"),
    )


def write(dataset: Dataset, T_world_camera: Array, path: Path) -> None:
    """Write transforms.json with images/ and depth/; or the file alone, its images where they lie.

    Where the name of ``path`` ends in .json, nothing else is written, and ``file_path`` leads to
    the images of the dataset, as ``depth_unit_scale_factor`` leads to their unit.
    """
    camera = camera_of(dataset, "nerfstudio")
    alone = path.suffix == ".json"
    scale = dataset.sensor.depth_scale if alone else SCALE
    colour = any("rgb" in frame.files for frame in dataset)
    if not alone:
        new_folder(path, "depth", *(("images",) if colour else ()))
    poses = CONVENTION.undone(T_world_camera)
    entries: list[dict[str, Any]] = []
    for k, frame, _ in each(dataset, T_world_camera):
        entry: dict[str, Any] = {}
        if alone:
            for kind, key in (("rgb", "file_path"), ("depth", "depth_file_path")):
                if kind in frame.files:
                    image = (frame.root / frame.files[kind].path).resolve()
                    entry[key] = Path(os.path.relpath(image, path.resolve().parent)).as_posix()
        else:
            if (rgb := frame.rgb()) is not None:
                entry["file_path"] = f"images/{k:06d}.png"
                write_png(path / entry["file_path"], rgb)
            entry["depth_file_path"] = f"depth/{k:06d}.png"
            write_png(path / entry["depth_file_path"], depth_pixels(frame, SCALE))
        entry.setdefault("file_path", entry["depth_file_path"])
        entries.append({**entry, "timestamp": frame.stamp, "transform_matrix": poses[k].tolist()})
    k1, k2, p1, p2, k3 = camera.distortion
    head = {
        "camera_model": "OPENCV" if any(camera.distortion) else "PINHOLE",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + HALF,
        "cy": camera.cy + HALF,
        **{"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2},
        "depth_unit_scale_factor": scale,
    }
    file = path if alone else path / FILE
    durable.make_folder(file.parent)
    durable.write_json(file, {**head, "frames": entries})


def _number(value: dict[str, Any], key: str, default: float, file: Path) -> float:
    found = value.get(key, default)
    number = _finite(found)
    if number is None or not number > 0:
        raise DatasetError(f"{file}: {key} is {shown(found)}, expected a number above 0")
    return number


def _stamp(value: Any, where: str) -> float:
    seconds = _finite(value)
    if seconds is None:
        raise DatasetError(f"{where}.timestamp is {shown(value)}, expected finite seconds")
    return seconds


def _finite(value: Any) -> float | None:
    """Return a finite number; None where it is none, or an integer that is none as a float."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _pose(entry: dict[str, Any], where: str) -> Array:
    try:
        T = np.array(entry["transform_matrix"], dtype=np.float64)
        if T.shape == (3, 4):
            T = np.vstack([T, [0, 0, 0, 1]])
        if T.shape != (4, 4):
            raise ValueError(f"shape {T.shape}")
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{where}.transform_matrix: {error}, expected 4x4 numbers") from error
    return T


def _camera(
    values: dict[str, Any],
    size: tuple[int, int] | None,
    reading: Reading,
    where: str,
    known: dict[tuple[float, ...], Camera],
) -> Camera:
    """Return the camera of a frame; ``known`` holds those met so far."""
    model = values.get("camera_model", "OPENCV")
    if model not in _MODELS and reading.intrinsics is None:
        raise DatasetError(
            f"{where}: camera_model {model!r}, expected one of {', '.join(_MODELS)}: "
            "undistort the images first"
        )
    try:
        told = [float(values.get(key, 0.0)) for key in ("k1", "k2", "p1", "p2", "k3")]
        lens = reading.intrinsics or (
            float(values["fl_x"]),
            float(values.get("fl_y", values["fl_x"])),
            float(values["cx"]) - HALF,
            float(values["cy"]) - HALF,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(
            f"{where}: {error!r}, expected fl_x, fl_y, cx, cy, or --intrinsics"
        ) from error
    if values.get("k4"):
        raise DatasetError(f"{where}: k4 is {values['k4']}, expected five coefficients at most")
    key = (*lens, *told)
    if key not in known or size is not None:
        width, height = size or (
            next(iter(known.values())).width,
            next(iter(known.values())).height,
        )
        for name, found in (("w", width), ("h", height)):
            if name in values and values[name] != found:
                raise DatasetError(
                    f"{where}: {name} is {values[name]!r}, but depth images have {found} pixels: "
                    "expected depth of the colour's size, or --intrinsics of the depth images"
                )
        known[key] = intrinsics.made(width, height, lens, reading.distortion or tuple(told), where)
    return known[key]


FORMAT = Format(
    "nerfstudio", "nerfstudio: transforms.json with depth_file_path", recognise, read, write
)
