"""An X-Y gantry: where it takes frames, and how wrong its pose reports are."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.errors import OptionError
from sim.engine import mujoco
from sim.rigs.track import Track, Triple, perturbed, scaled
from sim.seeds import stream

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GantryErrors:
    """Standard deviations of what a gantry gets wrong."""

    encoder: float = 0.001
    """Of each position along x and y, independent, m."""
    drift: float = 0.0015
    """Of the slow drift along x and y by the end of the capture, m (assumed)."""
    rail: float = 0.0003
    """Of the height, which no encoder sees, m (assumed)."""
    mounting_tilt: float = 0.003
    """Of the carriage's tilt about x and y, constant over the capture, rad (assumed)."""
    hand_eye_t: float = 0.002
    """Of the camera's place on the carriage, the same in all frames, m."""
    hand_eye_r: float = float(np.radians(0.3))
    """Of the camera's orientation on the carriage, the same in all frames, rad."""

    def sigma(self) -> tuple[Triple, Triple]:
        """What a pose report is worth in all: per world axis, m and rad."""
        along = float(np.sqrt(self.encoder**2 + self.drift**2 + self.hand_eye_t**2))
        up = float(np.hypot(self.rail, self.hand_eye_t))
        tilt = float(np.hypot(self.mounting_tilt, self.hand_eye_r))
        return (along, along, up), (tilt, tilt, self.hand_eye_r)


@dataclass(frozen=True)
class Gantry:
    """An X-Y gantry at constant height whose camera looks straight down.

    The image's long side lies along world y. A row of frames runs along x, the next one back.
    """

    x: tuple[float, float] = (0.0, 7.0)
    y: tuple[float, float] = (1.0, 5.0)
    """First and last position, m."""
    height: float = 3.0
    columns: int = 7
    rows: int = 3
    seconds: float = 4.0
    """Between frames: travel, settle, expose."""
    errors: GantryErrors = field(default_factory=GantryErrors)

    @property
    def frames(self) -> int:
        """How many it takes unless told otherwise."""
        return self.columns * self.rows

    def stations(self, frames: int | None = None) -> Array:
        """Camera centres (N, 3) m in order.

        Fewer frames than the grid holds keep its spacing and the corner at the origin; more make
        the columns denser.
        """
        count = self.frames if frames is None else frames
        if count < 1:
            raise OptionError(f"frames {count}: expected 1 or more")
        rows = min(self.rows, count)
        columns = -(-count // rows)
        step = (self.x[1] - self.x[0]) / (max(columns, self.columns) - 1)
        xs = self.x[0] + step * np.arange(columns)
        ys = np.linspace(*self.y, self.rows)[:rows]
        places = [
            (x, y, self.height)
            for row, y in enumerate(ys)
            for x in (xs if row % 2 == 0 else xs[::-1])
        ]
        return np.array(places)[:count]

    def track(
        self,
        model: mujoco.MjModel | None,
        seed: int,
        frames: int | None = None,
        start_error: tuple[float, float] | None = None,
        scale: float = 1.0,
    ) -> Track:
        """The capture's poses; the gantry itself is not in the model.

        `scale` multiplies the rig's errors (0: reports are exact). `start_error` (m, rad) replaces
        them by independent Gaussian errors per axis, frame 0 exact, for studies.
        """
        stations = self.stations(frames)
        down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        T_true = se3.make(np.broadcast_to(down, (len(stations), 3, 3)), stations)
        stamps = np.asarray(self.seconds * np.arange(len(stations)), np.float64)
        if start_error is not None:
            return perturbed(stamps, T_true, seed, start_error)
        if scale == 0.0:
            return Track(stamps, T_true, T_true)
        return self._reported(stamps, T_true, seed, scale)

    def _reported(self, stamps: Array, T_true: Array, seed: int, scale: float) -> Track:
        rng = stream(seed, "gantry")
        errors, count = self.errors, len(stamps)
        # The carriage's flange hangs above the camera, level, with its axes along the world's.
        T_flange_camera_true = se3.make(T_true[0, :3, :3], np.array([0.0, 0.0, -0.12]))
        T_world_flange = T_true @ se3.inverse(T_flange_camera_true)
        share = stamps / max(stamps[-1], 1.0)
        wave = np.sin(np.outer(share, [4.1, 5.3]) + rng.uniform(0.0, 6.3, 2))
        drift = share[:, None] + 0.5 * (wave - wave[0])
        t = np.zeros((count, 3))
        t[:, :2] = errors.encoder * rng.standard_normal((count, 2))
        t[:, :2] += errors.drift * rng.standard_normal(2) * drift
        t[:, 2] = errors.rail * rng.standard_normal(count)
        T_base_flange = T_world_flange.copy()
        T_base_flange[:, :3, 3] += scale * t
        # To the gantry its own tilt and the hand-eye error are one: a wrong T_flange_camera.
        wrong = np.zeros(6)
        wrong[:3] = errors.hand_eye_t * rng.standard_normal(3)
        wrong[3:] = errors.hand_eye_r * rng.standard_normal(3)
        wrong[3:5] += errors.mounting_tilt * rng.standard_normal(2)
        T_flange_camera = se3.retract(T_flange_camera_true, scale * wrong)
        sigma_t, sigma_r = errors.sigma()
        return Track(
            stamps,
            T_true,
            T_base_flange @ T_flange_camera,
            scaled(sigma_t, scale),
            scaled(sigma_r, scale),
            T_base_flange=T_base_flange,
            T_flange_camera=T_flange_camera,
            T_flange_camera_true=T_flange_camera_true,
        )
