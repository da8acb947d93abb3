"""A depth camera on the simulated arm or gantry: renders what it sees from where that truly is.

It is a camera to whoever has an interface like this: `open`, `capture`, `close`. The scene and the
arm's place it learns from the running controller's control channel, so that it needs no more than
the controller's address.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import se3
from depthba.camera import Camera
from depthba.errors import OptionError
from sim.controller.channel import Channel
from sim.controller.options import CONTROL_PORT
from sim.errors import SimulationError
from sim.noise import choose_stages, measure, stated_noise
from sim.noise.shot import Shot
from sim.noise.stage import Stage
from sim.rigs.clearance import joint_addresses
from sim.robots.ur16e import T_FLANGE_CAMERA
from sim.scenes import find_scene
from sim.sensors import DepthSensor, find_sensor
from sim.world import World

Array = NDArray[np.float64]

_SMALL = (64, 48)
_FROM_ABOVE = se3.make(np.diag([1.0, -1.0, -1.0]), [0.0, 0.5, 1.0])


@dataclass(frozen=True)
class SimulatedInfo:
    """What the camera is, as a dataset's sensor states it."""

    model: str
    serial: str
    camera: Camera
    depth_scale: float
    """Metres per count of a stored depth image."""
    depth_min: float | None
    depth_max: float | None
    """What it can measure, m."""
    noise: tuple[float, float, float] | None
    """sigma_m, at_m and power of the standard deviation; None: it has none."""
    noise_along: str = "range"
    """Whether that is of the range or of z."""
    settings: dict[str, str | float | bool] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class SimulatedCapture:
    """One frame, and what only the simulation knows of it."""

    depth: NDArray[np.float32]
    """(height, width) z, m; NaN where nothing was measured."""
    stamp: float
    """Host clock, s since the epoch."""
    rgb: NDArray[np.uint8] | None
    """(height, width, 3) or None."""
    T_world_camera_true: Array
    """(4, 4), the world being the scene's."""
    joints_true: Array
    """(n,) rad."""
    moment: float | None = None
    """`stamp` on the steady clock, s; None: whoever owns the camera knows."""


@dataclass(frozen=True)
class _Studio:
    """What frames are taken of, and with what."""

    world: World
    sensor: DepthSensor
    stages: tuple[Stage, ...]
    joints: NDArray[np.int64]
    """Where the arm's joints stand in qpos."""

    def expose(
        self, joints: Array, T_true: Array, seed: int, frame: int, rgb: bool
    ) -> tuple[Array, NDArray[np.uint8] | None]:
        """Depth and colour with the arm's joints at (n,) and the camera at (4, 4)."""
        qpos = np.array(self.world.model.qpos0, float)
        qpos[self.joints] = joints
        view = self.world.at(qpos)
        hits = view.rays.view(self.sensor.camera, T_true)
        image = view.painter.paint(self.sensor.camera, T_true, hits) if rgb else None
        shot = Shot(self.sensor, view.rays, self.world.finish, T_true, hits)
        return measure(hits.distance, shot, seed, frame, self.stages), image


class SimulatedCamera:
    """The depth camera on a simulated arm's flange.

    Raises SimulationError, and of it NoAnswer where the controller does not answer in time. The
    noise depends on the seed, on where the arm is, and on how many frames were taken there: who
    comes back to a pose in another session gets the same frame.
    """

    def __init__(
        self,
        host: str = "127.0.0.2",
        control_port: int = CONTROL_PORT,
        sensor: str | None = None,
        size: Sequence[int] | None = None,
        T_flange_camera: ArrayLike | None = None,
        seed: int = 0,
        clean: bool = False,
        rgb: bool = True,
    ) -> None:
        """Check the options; nothing is reached yet.

        Args:
            host: the controller's address.
            control_port: of its control channel.
            sensor: a name of `sim.sensors`. None: the scene's.
            size: width and height, pixels. None: the sensor's.
            T_flange_camera: (4, 4) where the camera truly sits, whatever the session believes.
                None: where the scene's model of the arm has it.
            seed: of the noise.
            clean: leave all noise out.
            rgb: whether to render colour images.
        """
        X = np.asarray(T_FLANGE_CAMERA if T_flange_camera is None else T_flange_camera, float)
        if X.shape != (4, 4) or not se3.is_rigid(X):
            raise OptionError(f"T_flange_camera {X.tolist()}: expected a rigid transform (4, 4)")
        if size is not None and len(size) != 2:
            raise OptionError(f"size {list(size)}: expected width and height, pixels")
        self.T_flange_camera_true: Array = X
        self._channel = Channel(host, control_port)
        self._sensor_name, self._size = sensor, size
        self._seed, self._clean, self._rgb = seed, clean, rgb
        self._studio: _Studio | None = None
        self._last: tuple[int, int] | None = None
        """The label of the pose of the last frame, and how many were taken there."""

    def open(self) -> SimulatedInfo:
        """Build the scene that the controller's arm stands in."""
        about = self._channel.ask("about")
        if about["scene"] is None:
            raise SimulationError(
                f"simulated controller {self._channel.host}: has no scene to be seen, expected"
                " --scene"
            )
        entry = find_scene(about["scene"])
        sensor = entry.sensor if self._sensor_name is None else find_sensor(self._sensor_name)
        sensor = find_sensor(sensor) if isinstance(sensor, str) else sensor
        if self._size is not None:
            sensor = sensor.resized(*map(int, self._size))
        world, stages = World.build(entry, about["seed"]), choose_stages(self._clean)
        names = tuple(about["joint_names"])
        # A gantry has none in the scene: it is not seen.
        joints = joint_addresses(world.model, names) if names else np.zeros(0, np.int64)
        self._studio, self._last = _Studio(world, sensor, stages, joints), None
        # What is compiled or built for a first frame must not take that frame's time.
        small = replace(self._studio, sensor=sensor.resized(*_SMALL))
        small.expose(np.zeros(len(joints)), _FROM_ABOVE, 0, 0, self._rgb)
        noise = stated_noise(sensor, stages)
        return SimulatedInfo(
            model=sensor.model,
            serial=f"simulated-{self._channel.host}",
            camera=sensor.camera,
            depth_scale=sensor.depth_scale,
            depth_min=sensor.depth_min,
            depth_max=sensor.depth_max,
            noise=None if noise is None else (noise.sigma_m, noise.at_m, noise.power),
            noise_along="range" if noise is None else noise.along,
            settings={"scene": entry.id, "seed": self._seed, "clean": self._clean},
        )

    def capture(self, timeout: float) -> SimulatedCapture:
        """A frame from where the arm is now; NoAnswer if that is not known after `timeout` s."""
        studio = self._studio
        if studio is None:
            raise SimulationError("simulated camera: is not open, expected `open` before `capture`")
        asked = time.time()
        truth = self._channel.ask("expose", timeout)
        stamp = 0.5 * (asked + time.time())
        joints = np.array(truth["joints"], float)
        T_true = np.array(truth["T_world_flange"], float) @ self.T_flange_camera_true
        label = self._label(joints if len(joints) else T_true[:3, 3])
        depth, image = studio.expose(joints, T_true, self._seed, label, self._rgb)
        return SimulatedCapture(depth.astype(np.float32), stamp, image, T_true, joints)

    def close(self) -> None:
        """Hang up and let go of the scene."""
        self._channel.close()
        self._studio = None

    def _label(self, joints: Array) -> int:
        """What the noise of a frame at these joints, or that place, (n,) is drawn by."""
        pose = zlib.crc32(np.round(1e5 * joints).astype(np.int64).tobytes())
        before = self._last
        count = before[1] + 1 if before is not None and before[0] == pose else 0
        self._last = pose, count
        return pose + (count << 32)
