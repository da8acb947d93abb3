"""From a source of any known format to a dataset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import __version__
from depthba.convert import files, overlap, registry, steps
from depthba.convert.reading import Reading
from depthba.convert.recording import Recording, SourceFrame
from depthba.dataset import Dataset, DatasetWriter, is_dataset
from depthba.dataset.sensor import DEPTH_LARGEST
from depthba.errors import DatasetError, OptionError
from depthba.words import count

__all__ = ["Imported", "into_dataset", "is_dataset", "read"]

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

STEPS = (1e-4, 1e-3)
"""Metres per step for depth that comes in floating-point numbers: the first in which all fits."""


@dataclass(frozen=True)
class Imported:
    """A dataset, and what should be known of how it came to be."""

    dataset: Dataset
    format: str
    notes: tuple[str, ...]


def read(path: Path, reading: Reading) -> Recording:
    """Read a source, by the conventions of its format or those given, and check them.

    Raises:
        DatasetError: it is of no known format, or of several; a file is missing or wrong; depth
            was rounded to a few whole numbers; or its frames overlap under another convention.
        OptionError: an option makes no sense.

    """
    _check(reading)
    found = registry.recognise(path) if reading.kind is None else registry.named(reading.kind)
    if found.read is None:
        raise OptionError(f"--kind {found.name}: is written only, not read")
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder")
    if path.is_dir() and not reading.outside:
        files.refuse_links_out(path)
    try:
        recording = found.read(path, reading).ready(reading)
    except OSError as error:
        raise DatasetError(f"{path}: {error}, expected files that can be read") from error
    if reading.unchecked:
        return replace(recording, notes=(*recording.notes, "conventions not checked"))
    steps.refuse_whole_numbers(recording)  # they agree a little under many a unit
    return replace(recording, notes=(*recording.notes, *overlap.check(recording)[1]))


def into_dataset(
    recording: Recording, path: Path, reading: Reading, progress: Progress | None = None
) -> Imported:
    """Write a recording as a dataset into a new folder.

    Frames whose intrinsics differ become clouds: a dataset has one camera.

    Raises:
        DatasetError: something is in the way, an image is missing or wrong, or depth is so small
            that its steps would leave little of it.

    """
    notes = list(recording.notes)
    cameras = {frame.camera for frame in recording.frames}
    as_clouds = len(cameras) > 1
    if as_clouds:
        notes.append(f"{len(cameras)} different intrinsics: frames become clouds, without colour")
    camera = next(iter(cameras))
    sensor: dict[str, Any] = {"kind": "cloud", "model": recording.model}
    if as_clouds or camera is None:
        sensor["origin"] = recording.origin
    else:
        scale = None if recording.floats else recording.depth_scale
        if scale is None:
            scale = _step(recording)
            notes.append(f"depth kept in steps of {scale:g} m")
        if not reading.unchecked:
            steps.refuse_coarse(recording, scale)
        sensor |= {"kind": "depth", **camera.json(), "depth_scale": scale}
    header = {
        "name": recording.path.resolve().stem or recording.format,
        "sensor": sensor,
        "map_frame": reading.map_frame,
        "source": {
            "tool": "depthba convert",
            "version": __version__,
            "format": recording.format,
            "convention": str(recording.convention),
        },
    }
    writer = DatasetWriter.create(path, header)
    poses = recording.T_world_camera
    blind = []
    for k, frame in enumerate(recording.frames):
        depth = _depth(frame, recording.path)
        cloud = frame.cloud() if frame.cloud is not None else None
        rgb = None
        if not (
            np.isfinite(depth).any() if depth is not None else cloud is not None and len(cloud)
        ):
            blind.append(frame.name)
        if depth is not None and as_clouds:
            assert frame.camera is not None
            cloud = frame.camera.backproject(depth)
            depth = None
        elif depth is not None and frame.rgb is not None:
            rgb = frame.rgb()
            if rgb.shape[:2] != depth.shape:
                raise DatasetError(
                    f"{recording.path}: colour of {frame.name} is {rgb.shape[1]} x {rgb.shape[0]}, "
                    f"depth {depth.shape[1]} x {depth.shape[0]} pixels, expected aligned images"
                )
        try:
            writer.add_frame(
                stamp=frame.stamp, T_world_camera=poses[k], depth=depth, cloud=cloud, rgb=rgb
            )
        except DatasetError as error:
            raise DatasetError(f"{recording.path}: {frame.name}: {error}") from error
        if progress is not None:
            progress(k + 1, len(recording.frames))
    if len(blind) == len(recording.frames):
        raise DatasetError(
            f"{recording.path}: nothing was measured in any frame ({blind[0]} and all others are "
            "empty), expected depth above 0"
        )
    if blind:
        names = ", ".join(blind[:3]) + (", …" if len(blind) > 3 else "")
        notes.append(f"nothing was measured in {count(len(blind), 'frame')} ({names})")
    return Imported(Dataset.open(path), recording.format, tuple(notes))


def _check(reading: Reading) -> None:
    for name in ("depth_scale", "pose_scale", "cloud_scale", "max_gap"):
        value = getattr(reading, name)
        if value is not None and not value > 0:
            raise OptionError(f"--{name.replace('_', '-')} {value:g}: expected above 0")
    if (scale := reading.depth_scale) is not None and scale > 1.0 and not reading.unchecked:
        raise OptionError(
            f"--depth-scale {scale:g}: expected metres a step, such as {1 / scale:g} for {scale:g} "
            "steps a metre, or --unchecked"
        )


def _depth(frame: SourceFrame, source: Path) -> Array | None:
    if frame.depth is None:
        return None
    z = frame.depth()
    assert frame.camera is not None
    if z.shape != (frame.camera.height, frame.camera.width):
        raise DatasetError(
            f"{source}: {frame.name}: {z.shape[1]} x {z.shape[0]} pixels, expected "
            f"{frame.camera.width} x {frame.camera.height} as the intrinsics are for"
        )
    return z


def _step(recording: Recording) -> float:
    """Return the finest step in which all depths of a recording fit 16 bits, m."""
    farthest = 0.0
    for frame in recording.frames:
        assert frame.depth is not None
        farthest = max(farthest, float(np.nanmax(frame.depth(), initial=0.0)))
    for step in STEPS:
        if farthest <= DEPTH_LARGEST * step:
            return step
    raise DatasetError(
        f"{recording.path}: depth up to {farthest:g} m, expected at most "
        f"{DEPTH_LARGEST * STEPS[-1]:g} m: is --depth-scale right?"
    )
