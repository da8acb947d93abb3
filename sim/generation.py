"""From a scene and a seed to a dataset folder: plan, render, measure, write."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import __version__
from depthba.dataset import Dataset, DatasetWriter, Marker
from depthba.durable import write_bytes, write_json, write_text
from depthba.errors import DatasetError
from sim import calibration, stored_scene
from sim.capture import Capture
from sim.markers import discs_of, observe
from sim.noise import stated_noise
from sim.options import DEFAULTS, GenerateOptions
from sim.scenes import Scene, find_scene

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]
"""Called with frames done, frames in all (0: not known yet), and what is being done."""

SCENE = "scene/scene.json"
"""Written last: a dataset that has it is finished."""


def generate(
    scene: str,
    out: str | Path,
    options: GenerateOptions = DEFAULTS,
    progress: Progress | None = None,
) -> Path:
    """Render a scene into the dataset folder `out` and return its path.

    `scene` is a name of `sim.SCENES`, the path of an MJCF file, or `module:function`. A folder that
    holds the same dataset is left as it is; one that was cut short is resumed. Raises
    SimulationError for an unknown scene, sensor, rig or stage, OptionError for a bad option,
    DatasetError where `out` holds anything else.
    """
    report = progress or (lambda done, total, text: None)
    entry, out = find_scene(scene), Path(out)
    if is_complete(scene, out, options):
        frames = len(Dataset.open(out))
        report(frames, frames, "there already")
        return out
    report(0, 0, "building the scene")
    capture = Capture.plan(entry, options)
    header = _header(scene, entry, capture)
    writer, done = _open(out, header)
    _store_assets(out, capture)

    discs = discs_of(capture.world.model, capture.world.at().data)
    seen: dict[str, list[tuple[int, Array]]] = {disc.name: [] for disc in discs}
    track, total = capture.track, len(capture)
    report(done, total, "rendering")
    # Of frames committed before a crash only the markers are still needed.
    for k in range(0 if discs else done, total):
        taken = capture.expose(k, rgb=options.rgb and k >= done)
        for disc in discs:
            shot = taken.shot
            p_camera = observe(
                disc, capture.sensor.camera, shot.T_world_camera, shot.hits, taken.depth
            )
            if p_camera is not None:
                seen[disc.name].append((k, p_camera))
        if k < done:
            continue
        writer.add_frame(
            stamp=float(track.stamps[k]),
            depth=taken.depth,
            rgb=taken.rgb,
            T_world_camera=track.T_world_camera[k],
            T_world_camera_true=track.T_world_camera_true[k],
            joints=None if track.joints is None else track.joints[k],
            T_base_flange=None if track.T_base_flange is None else track.T_base_flange[k],
        )
        report(k + 1, total, "rendering")
    if discs:
        writer.write_markers(
            [Marker(disc.name, disc.p_world, tuple(seen[disc.name])) for disc in discs]
        )
    board = calibration.of_model(capture.world.model, capture.world.at().data, track)
    if board is not None:
        writer.write_calibration(board)
    write_json(
        out / SCENE,
        {
            "scene": header["source"]["scene"],
            "seed": options.seed,
            "model": "scene.xml",
            "frames": total,
        },
    )
    return out


def is_complete(scene: str, out: str | Path, options: GenerateOptions) -> bool:
    """Whether `out` holds this very dataset, finished; the images themselves are not read."""
    out = Path(out)
    if not (out / SCENE).is_file():
        return False
    try:
        source = json.loads((out / "dataset.json").read_text(encoding="utf-8"))["source"]
        frames = json.loads((out / SCENE).read_text(encoding="utf-8"))["frames"]
        listed = (out / "frames.jsonl").read_bytes().count(b"\n")
    except (OSError, ValueError, LookupError, TypeError):
        return False
    if source != _source(scene, options) or listed != frames:
        return False
    try:
        Dataset.open(out)
    except DatasetError:  # a file was taken away since
        return False
    return True


def draw_stages(scene: str, path: str | Path, options: GenerateOptions, frame: int = 0) -> Path:
    """Draw what each stage of the noise does to a frame, as a PNG; returns its path."""
    from sim.contact_sheet import contact_sheet

    capture = Capture.plan(find_scene(scene), options)
    shot = capture.expose(frame, rgb=False).shot
    title = f"{scene}, frame {frame}, {capture.sensor.model}"
    contact_sheet(path, title, capture.sensor, capture.stages, shot, options.seed, frame)
    return Path(path)


def rebuild(dataset: str | Path, out: str | Path, progress: Progress | None = None) -> Path:
    """Render a generated dataset anew from what it says about itself; equal bytes come out.

    A scene that was an MJCF file is read from the dataset itself, whose own hash is then another;
    one that a function built is built by it anew: rebuild no such dataset of somebody else's.
    DatasetError where `dataset` was not generated, or with other versions than those here.
    """
    source = Dataset.open(dataset).header.get("source", {})
    if not {"scene", "config", "versions"} <= source.keys():
        raise DatasetError(f"{dataset}: dataset.json names no scene and config to rebuild it from")
    if source["versions"] != _versions():
        raise DatasetError(
            f"{dataset}: made with {_listed(source['versions'])}, here are {_listed(_versions())};"
            " expected the same"
        )
    config: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in source["config"].items()
    }
    scene = source["scene"]
    if "scene_sha256" in source:
        stored_scene.read(dataset)
        scene = str(Path(dataset) / stored_scene.SCENE)
    return generate(scene, out, GenerateOptions(**config), progress)


def _source(scene: str, options: GenerateOptions) -> dict[str, Any]:
    """Where the dataset comes from: all that decides its bytes."""
    source: dict[str, Any] = {
        "tool": "depthba generate",
        "version": __version__,
        "scene": Path(scene).name if Path(scene).is_file() else scene,
        "config": json.loads(json.dumps(asdict(options))),
        "versions": _versions(),
    }
    if Path(scene).is_file():
        source["scene_sha256"] = hashlib.sha256(Path(scene).read_bytes()).hexdigest()
    return source


@functools.cache
def _versions() -> dict[str, str]:
    return {name: version(name) for name in ("mujoco", "embreex", "numpy", "scipy")}


def _listed(versions: dict[str, str]) -> str:
    return ", ".join(f"{name} {number}" for name, number in versions.items())


def _header(scene: str, entry: Scene, capture: Capture) -> dict[str, Any]:
    sensor, track, options = capture.sensor, capture.track, capture.options
    header: dict[str, Any] = {
        "format": "depthba-dataset",
        "version": 1,
        "name": entry.id,
        "sensor": {
            "kind": "depth",
            "model": sensor.model,
            **sensor.camera.json(),
            "depth_scale": sensor.depth_scale,
            "depth_min": sensor.depth_min,
            "depth_max": sensor.depth_max,
        },
        "map_frame": "world",
        "seed": options.seed,
        "source": _source(scene, options),
    }
    noise = stated_noise(sensor, capture.stages)
    if noise is not None:
        header["sensor"]["noise"] = asdict(noise)
    if track.sigma_t is not None and track.sigma_r is not None:
        header["pose_noise"] = {
            "sigma_t_m": list(track.sigma_t),
            "sigma_r_rad": list(track.sigma_r),
        }
    if track.T_flange_camera is not None:
        header["T_flange_camera"] = track.T_flange_camera.tolist()
    return header


def _open(out: Path, header: dict[str, Any]) -> tuple[DatasetWriter, int]:
    """A writer for the folder, and how many frames it already holds."""
    if not (out / "dataset.json").is_file():
        return DatasetWriter.create(out, header), 0
    try:
        there = json.loads((out / "dataset.json").read_text(encoding="utf-8"))
    except ValueError:
        there = None
    if there != header:
        raise DatasetError(
            f"{out}: holds another dataset; expected a new folder, or the same cut short"
        )
    writer = DatasetWriter.resume(out)
    return writer, len(Dataset.open(out))


def _store_assets(out: Path, capture: Capture) -> None:
    """Put the scene beside its frames: the model, and the files that it names."""
    folder = out / "scene"
    folder.mkdir(exist_ok=True)
    write_text(folder / "scene.xml", capture.world.xml)
    for name, data in sorted(capture.world.assets.items()):
        write_bytes(folder / name, data)
