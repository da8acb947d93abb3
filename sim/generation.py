"""From a scene and a seed to a dataset folder: build, cast, measure, write."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import __version__
from depthba.dataset import Dataset, DatasetWriter, Marker
from depthba.durable import write_json, write_text
from depthba.errors import DatasetError, OptionError
from sim.engine import mujoco
from sim.markers import discs_of, observe
from sim.noise import choose_stages, measure
from sim.noise.shot import Shot
from sim.rigs import find_rig
from sim.rigs.track import Track
from sim.scenes import Scene, find_scene
from sim.sensors import DepthSensor, find_sensor
from sim.world import World

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]
"""Called with frames done, frames in all, and what is being done."""


@dataclass(frozen=True)
class GenerateOptions:
    """What to vary of a scene's dataset. Equal options give equal bytes."""

    seed: int = 0
    """Arrangement, noise and pose errors."""
    frames: int | None = None
    """Number of frames. None: the rig's own (industrial scenes: 21)."""
    size: tuple[int, int] | None = None
    """Image width and height, pixels. None: the sensor's own (SP1000: 1280 x 960)."""
    start_error: tuple[float, float] | None = None
    """Instead of the rig's pose errors: independent Gaussian errors per axis; frame 0 is exact.

    The standard deviations, m and rad."""
    clean: bool = False
    """Leave all noise out, of the depth and of the poses; start_error still counts."""
    pose_noise: float = 1.0
    """Factor on the rig's pose errors."""
    without: tuple[str, ...] = ()
    """Stages of the sensor's noise to leave out, by name."""
    rgb: bool = True
    """Whether to render colour images too."""

    def __post_init__(self) -> None:
        """OptionError names a value that makes no sense."""
        if self.seed < 0:
            raise OptionError(f"seed {self.seed}: expected 0 or more")
        if self.frames is not None and self.frames < 1:
            raise OptionError(f"frames {self.frames}: expected 1 or more")
        if not (np.isfinite(self.pose_noise) and self.pose_noise >= 0.0):
            raise OptionError(f"pose_noise {self.pose_noise}: expected a factor of 0 or more")


def generate(
    scene: str,
    out: str | Path,
    options: GenerateOptions = GenerateOptions(),
    progress: Progress | None = None,
) -> Path:
    """Render a scene into the dataset folder `out` and return its path.

    A folder that holds the same dataset, cut short, is resumed. Raises SimulationError for an
    unknown scene or stage, OptionError for a bad option, DatasetError where `out` holds anything
    else.
    """
    report = progress or (lambda done, total, text: None)
    entry, out = find_scene(scene), Path(out)
    sensor = find_sensor(entry.sensor)
    if options.size is not None:
        sensor = sensor.resized(*options.size)
    stages = choose_stages(options.clean, options.without)
    scale = 0.0 if options.clean else options.pose_noise
    report(0, 0, "building the scene")
    world = World.build(entry, options.seed)
    track = find_rig(entry.rig).track(
        world.model, options.seed, options.frames, options.start_error, scale
    )
    writer, done = _open(out, _header(entry, sensor, track, options))
    _store_scene(out, entry, options, world)
    discs = discs_of(world.model, world.at().data)
    seen: dict[str, list[tuple[int, Array]]] = {disc.name: [] for disc in discs}

    camera, total = sensor.camera, len(track.stamps)
    report(done, total, "rendering")
    for k in range(total):
        T_true = track.T_world_camera_true[k]
        view = world.at(None if track.qpos is None else track.qpos[k])
        hits = view.rays.view(camera, T_true)
        shot = Shot(sensor, view.rays, world.finish, T_true, hits)
        depth = measure(hits.distance, shot, options.seed, k, stages)
        for disc in discs:
            p_camera = observe(disc, camera, T_true, hits, depth)
            if p_camera is not None:
                seen[disc.name].append((k, p_camera))
        if k < done:  # committed before a crash; only its markers were still needed
            continue
        writer.add_frame(
            stamp=float(track.stamps[k]),
            depth=depth,
            rgb=view.painter.paint(camera, T_true, hits) if options.rgb else None,
            T_world_camera=track.T_world_camera[k],
            T_world_camera_true=T_true,
            joints=None if track.joints is None else track.joints[k],
            T_base_flange=None if track.T_base_flange is None else track.T_base_flange[k],
        )
        report(k + 1, total, "rendering")
    if discs:
        writer.write_markers(
            [Marker(disc.name, disc.p_world, tuple(seen[disc.name])) for disc in discs]
        )
    return out


def _header(
    entry: Scene, sensor: DepthSensor, track: Track, options: GenerateOptions
) -> dict[str, Any]:
    camera, noise = sensor.camera, sensor.noise
    header: dict[str, Any] = {
        "format": "depthba-dataset",
        "version": 1,
        "name": entry.id,
        "sensor": {
            "kind": "depth",
            "model": sensor.model,
            **{k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")},
            "distortion": list(camera.distortion),
            "depth_scale": sensor.depth_scale,
            "depth_min": sensor.depth_min,
            "depth_max": sensor.depth_max,
        },
        "map_frame": "world",
        "seed": options.seed,
        "source": {
            "tool": "depthba generate",
            "version": __version__,
            "scene": entry.id,
            "config": json.loads(json.dumps(asdict(options))),
            "engine": f"mujoco {mujoco.__version__}",
        },
    }
    if not options.clean and "range-noise" not in options.without:
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


def _store_scene(out: Path, entry: Scene, options: GenerateOptions, world: World) -> None:
    folder = out / "scene"
    folder.mkdir(exist_ok=True)
    write_text(folder / "scene.xml", world.xml)
    write_json(
        folder / "scene.json",
        {
            "scene": entry.id,
            "seed": options.seed,
            "model": "scene.xml",
            "mujoco": mujoco.__version__,
        },
    )
