"""Choosing from datasets: cropped, masked, merged; nothing is written, files are read when asked.

These are the bodies of the methods of `depthba.dataset.Dataset`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from depthba import bounds
from depthba.dataset.cutting import Bounds, Cut, Roi
from depthba.dataset.listing import STAMP_TOLERANCE
from depthba.dataset.model import Frame
from depthba.dataset.sensor import Sensor
from depthba.errors import DatasetError, OptionError

if TYPE_CHECKING:
    from depthba.dataset.reading import Dataset

Array = NDArray[np.float64]


def map_frame(dataset: Dataset) -> Array:
    """Return T_map_world (4, 4) as a registration from the measured poses chooses it."""
    from depthba.optimiser.problem import choose_map_frame  # compiles much that reading needs not

    if dataset.map_frame == "world" or not len(dataset):
        return np.eye(4)
    poses = dataset.T_world_camera_measured
    common = np.linalg.norm(poses[:, :3, 2].mean(axis=0)) >= 0.5
    clouds = [] if common else [frame.points() for frame in dataset]
    return choose_map_frame(dataset.map_frame, clouds, poses)


def crop(
    dataset: Dataset, roi: Roi | None, *, heights: Bounds | None, depths: Bounds | None
) -> Dataset:
    """See `Dataset.crop`."""
    for name, pair in (("heights", heights), ("depths", depths)):
        if pair is not None and not pair[0] < pair[1]:
            raise OptionError(f"{name}: {pair[0]:g} is not below {pair[1]:g}")
    if roi is not None:
        for axis, low, high in zip("xyz", roi[0::2], roi[1::2], strict=True):
            if not low < high:
                raise OptionError(
                    f"roi: {axis}min {low:g} is not below {axis}max {high:g} "
                    "(expected xmin xmax ymin ymax zmin zmax)"
                )
    box = roi
    if heights is not None:
        x0, x1, y0, y1, z0, z1 = roi or (-math.inf, math.inf) * 3
        box = (x0, x1, y0, y1, max(z0, heights[0]), min(z1, heights[1]))
    if box is None:
        return _cut(dataset, lambda _: Cut(depths=depths)) if depths is not None else dataset
    T_map_world = map_frame(dataset)
    return _cut(
        dataset,
        lambda frame: Cut(depths=depths, roi=box, T_map_camera=T_map_world @ frame.T_world_camera),
    )


def masked(dataset: Dataset, mask: NDArray[Any] | str | Path) -> Dataset:
    """See `Dataset.masked`."""
    camera = dataset.sensor.camera
    if camera is None:
        raise DatasetError(f"{dataset.path}: holds clouds, but a mask is for depth images")
    shape = (camera.height, camera.width)
    if isinstance(mask, np.ndarray):
        if mask.shape != shape:
            raise DatasetError(
                f"mask of shape {mask.shape}, expected (height, width) = {shape}, as the sensor has"
            )
        counts = mask != 0
        return _cut(dataset, lambda _: Cut(mask=counts))
    path = Path(mask)
    if path.is_dir():
        return _cut(
            dataset,
            lambda frame: Cut(mask=_mask_file(path / Path(frame.files["depth"].path).name, shape)),
        )
    counts = _mask_file(path, shape)
    return _cut(dataset, lambda _: Cut(mask=counts))


def merge(datasets: Sequence[Dataset], name: str) -> Dataset:
    """See `Dataset.merge`."""
    if not datasets:
        raise DatasetError("no dataset to merge, expected one or more")
    first = datasets[0]
    frames: list[Frame] = []
    for dataset in datasets:
        if difference := _differs(first.sensor, dataset.sensor):
            raise DatasetError(
                f"{dataset.path}: {difference} as in {first.path}: "
                "frames of different sensors are not merged"
            )
        shift = _shift([frame.stamp for frame in frames], [frame.stamp for frame in dataset])
        for frame in dataset:
            moved = replace(frame, id=len(frames), stamp=frame.stamp + shift)
            frames.append(moved if frame.record else replace(moved, record=_record(frame)))
    frame_of_map = {dataset.map_frame for dataset in datasets}
    return replace(
        first,
        name=name or "+".join(dict.fromkeys(dataset.name for dataset in datasets)),
        map_frame=first.map_frame if len(frame_of_map) == 1 else "auto",
        frames=tuple(frames),
        warnings=tuple(w for dataset in datasets for w in dataset.warnings),
        left_out=frozenset(),
    )


def as_stored(frame: Frame) -> Frame:
    """Return a frame with the id and the stamp that its own folder knows it by."""
    return replace(
        frame,
        id=frame.record.get("id", frame.id),
        stamp=float(frame.record.get("stamp", frame.stamp)),
    )


def _record(frame: Frame) -> dict[str, Any]:
    return {"id": frame.id, "stamp": frame.stamp}


def _shift(taken: list[float], stamps: list[float]) -> float:
    """Return what makes stamps differ from those taken, s: 0 where they do already."""
    if not taken or not stamps:
        return 0.0
    there = np.sort(taken)
    place = np.searchsorted(there, stamps)
    nearest = np.minimum(
        np.abs(there[np.clip(place - 1, 0, len(there) - 1)] - stamps),
        np.abs(there[np.clip(place, 0, len(there) - 1)] - stamps),
    )
    if (nearest > 4 * STAMP_TOLERANCE).all():
        return 0.0
    return float(there[-1] - min(stamps) + 1.0)


def _differs(a: Sensor, b: Sensor) -> str:
    """Return what differs in how images are turned into points, or ""."""
    if a.kind != b.kind:
        return f"sensor.kind is {b.kind!r}, expected {a.kind!r}"
    for field in fields(a.camera) if a.camera is not None else ():
        if getattr(a.camera, field.name) != getattr(b.camera, field.name):
            return (
                f"sensor.{field.name} is {getattr(b.camera, field.name)}, "
                f"expected {getattr(a.camera, field.name)}"
            )
    if a.origin != b.origin:
        return f"sensor.origin is {b.origin}, expected {a.origin}"
    return ""


def _cut(dataset: Dataset, of: Callable[[Frame], Cut]) -> Dataset:
    frames = tuple(replace(frame, cuts=(*frame.cuts, of(frame))) for frame in dataset.frames)
    return replace(dataset, frames=frames)


def _mask_file(path: Path, shape: tuple[int, int]) -> NDArray[np.bool_]:
    import cv2

    if not path.is_file():
        raise DatasetError(f"{path}: no such file, expected an image to mask with")
    data = path.read_bytes()
    try:
        bounds.check_image(data)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except (ValueError, cv2.error) as error:
        raise DatasetError(f"{path}: {error}, expected an image to mask with") from error
    if image is None:
        raise DatasetError(f"{path}: not an image, expected one to mask with")
    if image.shape != shape:
        raise DatasetError(
            f"{path}: {image.shape[1]} x {image.shape[0]} pixels, "
            f"expected {shape[1]} x {shape[0]} as the sensor has"
        )
    return np.asarray(image != 0)
