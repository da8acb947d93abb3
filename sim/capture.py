"""A simulated capture: a scene, a rig that carries a sensor through it, and the frames it takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.noise import choose_stages, measure
from sim.noise.shot import Shot
from sim.noise.stage import Stage
from sim.options import GenerateOptions
from sim.rigs import find_rig
from sim.rigs.track import Track
from sim.scenes import Scene
from sim.sensors import DepthSensor, find_sensor
from sim.world import World

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Exposure:
    """What the sensor brings home of one frame, and how it came about."""

    depth: Array
    """(height, width) m; NaN: no measurement."""
    rgb: NDArray[np.uint8] | None
    """(height, width, 3)."""
    exact: Array
    """(height, width) m, before the noise."""
    shot: Shot


@dataclass(frozen=True)
class Capture:
    """All that is decided before the first frame."""

    options: GenerateOptions
    sensor: DepthSensor
    stages: tuple[Stage, ...]
    world: World
    track: Track

    @classmethod
    def plan(cls, entry: Scene, options: GenerateOptions) -> Capture:
        """Build the scene and plan the poses; SimulationError names an unknown sensor or stage."""
        sensor = sensor_of(entry, options)
        stages = choose_stages(options.clean, options.without, options.white)
        rig = find_rig(options.rig or entry.rig)
        world = World.build(entry, options.seed, options.settled)
        scale = 0.0 if options.clean else options.pose_noise
        track = rig.track(world.model, options.seed, options.frames, options.start_error, scale)
        return cls(options, sensor, stages, world, track)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.track.stamps)

    def expose(self, k: int, rgb: bool = True) -> Exposure:
        """Frame `k`: rendered, and spoilt as the sensor spoils it; `rgb` False saves the colour."""
        camera, T_true = self.sensor.camera, self.track.T_world_camera_true[k]
        view = self.world.at(None if self.track.qpos is None else self.track.qpos[k])
        hits = view.rays.view(camera, T_true)
        exact, image = hits.distance, None
        if self.options.renderer == "mujoco":
            exact = self.world.gl.depth(camera, T_true, view.data)
            image = self.world.gl.rgb(camera, T_true, view.data) if rgb else None
        elif rgb:
            image = view.painter.paint(camera, T_true, hits)
        shot = Shot(self.sensor, view.rays, self.world.finish, T_true, hits)
        depth = measure(exact, shot, self.options.seed, k, self.stages)
        return Exposure(depth, image, exact, shot)


def sensor_of(entry: Scene, options: GenerateOptions) -> DepthSensor:
    """The sensor in the size and with the noise that the options ask for."""
    sensor = options.sensor or entry.sensor
    sensor = find_sensor(sensor) if isinstance(sensor, str) else sensor
    sensor = sensor.noisier(options.depth_noise)
    return sensor if options.size is None else sensor.resized(*options.size)
