"""dataset.json: what the dataset is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from depthba import bounds
from depthba.camera import Camera, RangeNoise
from depthba.dataset import fields
from depthba.dataset.faults import Faults, MalformedError
from depthba.dataset.listing import inside
from depthba.dataset.sensor import HandEyeNoise, PoseNoise, Sensor
from depthba.errors import DatasetError
from depthba.trajectory import read_text

FORMAT = "depthba-dataset"
VERSION = 1
FILE = "dataset.json"
Triple = tuple[float, float, float]
_READ = (FILE, "frames.jsonl", "markers.json", "calibration.json")
"""Beside the poses, what is read without being listed."""


@dataclass(frozen=True, eq=False)
class Header:
    """dataset.json, checked."""

    name: str
    sensor: Sensor
    map_frame: Literal["world", "auto"]
    seed: int | None
    pose_noise: PoseNoise | None
    T_flange_camera: NDArray[np.float64] | None
    raw: dict[str, Any]
    """The whole object, unknown keys too."""


def read_header(root: Path, faults: Faults) -> Header | None:
    """Read dataset.json of the folder ``root``; None where it is too wrong to go on."""
    try:
        text = _header_text(root)
    except DatasetError as error:
        if faults.strict:
            raise
        faults.add("", None, str(error))
        return None
    with faults.within(FILE):
        return parse_header(
            fields.mapping(fields.parse(text), "it"), faults, default_name=root.name
        )
    return None


def parse_header(raw: Mapping[str, Any], faults: Faults, default_name: str = "") -> Header | None:
    """Check the object of dataset.json; None where it is too wrong to go on."""
    with faults.within(FILE):
        fields.choice(fields.required(raw, "format"), "format", (FORMAT,))
        _check_version(fields.required(raw, "version"))
        sensor = _sensor(fields.mapping(fields.required(raw, "sensor"), "sensor"), faults)
        name, seed, map_frame = default_name, None, "auto"
        pose_noise, T_flange_camera = None, None
        with faults.within(FILE):
            name = fields.text(raw.get("name", default_name), "name")
        with faults.within(FILE):
            map_frame = fields.choice(raw.get("map_frame", "auto"), "map_frame", ("world", "auto"))
        with faults.within(FILE):
            if raw.get("seed") is not None:
                seed = fields.integer(raw["seed"], "seed")
        with faults.within(FILE):
            if raw.get("pose_noise") is not None:
                pose_noise = _pose_noise(fields.mapping(raw["pose_noise"], "pose_noise"))
        with faults.within(FILE):
            if raw.get("T_flange_camera") is not None:
                T_flange_camera = fields.rigid(raw["T_flange_camera"], "T_flange_camera")
        if sensor is None:
            return None
        return Header(
            name=name,
            sensor=sensor,
            map_frame=cast(Literal["world", "auto"], map_frame),
            seed=seed,
            pose_noise=pose_noise,
            T_flange_camera=T_flange_camera,
            raw=dict(raw),
        )
    return None


def _header_text(root: Path) -> str:
    try:
        if not root.exists():
            raise DatasetError(f"{root}: no such folder, expected a dataset")
        if not root.is_dir():
            raise DatasetError(f"{root}: not a folder, expected a dataset (a folder with {FILE})")
        entries = {entry.name for entry in root.iterdir()}
    except OSError as error:
        raise DatasetError(f"{root}: {error.strerror}, expected a readable folder") from error
    if FILE not in entries:
        raise DatasetError(
            f"{root}: no {FILE} in it, expected a dataset; `depthba convert` makes one"
        )
    for name in sorted(entries):
        if name in _READ or name.startswith("poses_"):
            try:
                inside(root, name)
            except MalformedError as error:
                raise DatasetError(f"{root}: {error}") from error
    return read_text(root / FILE)


def _check_version(version: Any) -> None:
    fields.integer(version, "version", least=1)
    if version > VERSION:
        raise MalformedError(
            f"version is {version}, expected {VERSION}: it takes a newer depthba to read it"
        )


def _sensor(raw: fields.Record, faults: Faults) -> Sensor | None:
    """Check the object ``sensor``; every part on its own, so that all faults come out at once."""
    kind = fields.choice(fields.required(raw, "kind"), "sensor.kind", ("depth", "cloud"))
    before = len(faults.found)
    model, camera, scale, noise, origin = "", None, None, None, True
    with faults.within(FILE):
        model = fields.text(raw.get("model", ""), "sensor.model")
    with faults.within(FILE):
        if raw.get("noise") is not None:
            noise = _noise(fields.mapping(raw["noise"], "sensor.noise"))
    low, high = _range(raw, faults)
    if kind == "cloud":
        with faults.within(FILE):
            origin = raw.get("origin", False)
            if not isinstance(origin, bool):
                raise MalformedError(
                    f"sensor.origin is {fields.shown(origin)}, expected true or false"
                )
    else:
        camera = _camera(raw, faults)
        with faults.within(FILE):
            scale = fields.number(
                fields.required(raw, "depth_scale"), "sensor.depth_scale", above=0
            )
    if len(faults.found) > before:
        return None
    return Sensor(
        kind=cast(Literal["depth", "cloud"], kind),
        model=model,
        camera=camera,
        depth_scale=scale,
        depth_min=low,
        depth_max=high,
        noise=noise,
        origin=origin,
    )


def _camera(raw: fields.Record, faults: Faults) -> Camera | None:
    size: dict[str, int] = {}
    lens: dict[str, float] = {}
    for key in ("width", "height"):
        with faults.within(FILE):
            size[key] = fields.integer(fields.required(raw, key), f"sensor.{key}", least=1)
    for key in ("fx", "fy"):
        with faults.within(FILE):
            lens[key] = fields.number(fields.required(raw, key), f"sensor.{key}", above=0)
    for key in ("cx", "cy"):
        with faults.within(FILE):
            lens[key] = fields.number(fields.required(raw, key), f"sensor.{key}")
    distortion: tuple[float, ...] = (0.0,) * 5
    with faults.within(FILE):
        if raw.get("distortion") is not None:
            distortion = fields.numbers(raw["distortion"], "sensor.distortion", length=5)
    if len(size) < 2 or len(lens) < 4:
        return None
    with faults.within(FILE):
        try:
            bounds.check_pixels(size["width"], size["height"])
        except ValueError as error:
            raise MalformedError(f"sensor.width x sensor.height is {error}") from error
    k1, k2, p1, p2, k3 = distortion
    return Camera(
        size["width"],
        size["height"],
        lens["fx"],
        lens["fy"],
        lens["cx"],
        lens["cy"],
        (k1, k2, p1, p2, k3),
    )


def _range(raw: fields.Record, faults: Faults) -> tuple[float | None, float | None]:
    low, high = None, None
    with faults.within(FILE):
        if raw.get("depth_min") is not None:
            low = fields.number(raw["depth_min"], "sensor.depth_min", least=0)
    with faults.within(FILE):
        if raw.get("depth_max") is not None:
            high = fields.number(raw["depth_max"], "sensor.depth_max", above=low or 0)
    return low, high


def _noise(raw: fields.Record) -> RangeNoise:
    along = fields.choice(raw.get("along", "range"), "sensor.noise.along", ("range", "z"))
    return RangeNoise(
        sigma_m=fields.number(fields.required(raw, "sigma_m"), "sensor.noise.sigma_m", least=0),
        at_m=fields.number(raw.get("at_m", 1.0), "sensor.noise.at_m", above=0),
        power=fields.number(raw.get("power", 0.0), "sensor.noise.power"),
        along=cast(Literal["range", "z"], along),
    )


def _pose_noise(raw: fields.Record) -> PoseNoise:
    hand_eye = None
    if raw.get("hand_eye") is not None:
        name = "pose_noise.hand_eye"
        hand_eye = HandEyeNoise(*_sigmas(fields.mapping(raw["hand_eye"], name), name))
    return PoseNoise(*_sigmas(raw, "pose_noise"), hand_eye)


def _sigmas(raw: fields.Record, name: str) -> tuple[Triple, Triple]:
    """Return the standard deviations along three axes, m, and about them, rad."""
    t, r = (
        fields.numbers(fields.required(raw, key), f"{name}.{key}", length=3, least=0)
        for key in ("sigma_t_m", "sigma_r_rad")
    )
    return (t[0], t[1], t[2]), (r[0], r[1], r[2])
