"""A smooth relief of random waves, ray-cast to rounding, and datasets of it with truth.

Like bumpy-b: 4 cm high, waves of 0.3 to 1.2 m, slopes of about 0.3, seen from 0.6 m in 4 columns
and 3 rows unless another grid of cameras is asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import Camera
from depthba.dataset import Dataset, DatasetWriter

Floats = NDArray[np.float64]

WAVES, RMS_HEIGHT, DEPTH_SCALE = 16, 0.044, 2e-5
STEP_X, STEP_Y, ALTITUDE = 0.31, 0.24, 0.6


@dataclass(frozen=True)
class Relief:
    """What is seen, from where, and how well; equal fields give equal bytes."""

    seed: int = 0
    noise: float = 0.001
    """Standard deviation along the ray, m."""
    columns: int = 4
    rows: int = 3
    size: tuple[int, int] = (320, 240)
    start_error: tuple[float, float] = (0.01, 0.02)
    """Standard deviation of the measured poses per axis, m and rad; frame 0 is exact."""

    @property
    def camera(self) -> Camera:
        """As wide as 300 pixels of focal length are at 320 x 240."""
        width, height = self.size
        f = 300.0 * width / 320.0
        return Camera(width, height, f, f, 0.5 * (width - 1), 0.5 * (height - 1))

    def cameras(self) -> Floats:
        """Return (N, 4, 4), looking down, tilted by about 5 degrees; rows run to and fro."""
        rng = np.random.default_rng([self.seed, 1])
        count = self.columns * self.rows
        T = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (count, 1, 1))
        turn = rng.normal(size=(count, 3)) * 0.08
        T[:, :3, :3] = se3.exp_so3(turn) @ T[:, :3, :3]
        row, column = np.divmod(np.arange(count), self.columns)
        column = np.where(row % 2, self.columns - 1 - column, column)
        grid = np.column_stack([STEP_X * column, STEP_Y * row, np.full(count, ALTITUDE)])
        T[:, :3, 3] = grid + rng.normal(size=(count, 3)) * [0.02, 0.02, 0.03]
        return T

    def depths(self) -> list[Floats]:
        """Return each frame's depth (height, width) without noise, m."""
        waves = self._waves()
        return [_ray_cast(self.camera, T, waves) for T in self.cameras()]

    def write(self, path: Path) -> Dataset:
        """Write the dataset, or return it where it is already."""
        if (path / "complete").is_file():
            return Dataset.open(path)
        rng = np.random.default_rng([self.seed, 2])
        T_true = self.cameras()
        error = rng.standard_normal((len(T_true), 6)) * np.repeat(self.start_error, 3)
        error[0] = 0.0
        T_measured = se3.retract(T_true, error)
        camera = self.camera
        sensor = {
            "kind": "depth", "model": "analytic", "width": camera.width, "height": camera.height,
            "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "distortion": [0] * 5, "depth_scale": DEPTH_SCALE, "depth_min": 0.1, "depth_max": 1.2,
            "noise": {"sigma_m": self.noise, "at_m": 1.0, "power": 0},
        }  # fmt: skip
        header = {"name": "relief", "sensor": sensor, "map_frame": "world", "seed": self.seed}
        writer = DatasetWriter.create(path, header)
        along_ray = 1 / np.linalg.norm(camera.rays(), axis=-1)
        waves = self._waves()
        for i, T in enumerate(T_true):
            depth = _ray_cast(camera, T, waves)
            writer.add_frame(
                stamp=float(i),
                depth=depth + self.noise * rng.standard_normal(depth.shape) * along_ray,
                T_world_camera=T_measured[i],
                T_world_camera_true=T,
            )
        (path / "complete").touch()
        return Dataset.open(path)

    def _waves(self) -> Floats:
        """Return (WAVES, 4): wave vector x and y, rad/m, phase, amplitude, m."""
        rng = np.random.default_rng([self.seed, 3])
        length = np.exp(rng.uniform(np.log(0.3), np.log(1.2), WAVES))
        angle, phase = rng.uniform(0, 2 * np.pi, (2, WAVES))
        amplitude = length / np.sqrt((length**2).sum() / 2) * RMS_HEIGHT
        k = 2 * np.pi / length
        return np.column_stack([k * np.cos(angle), k * np.sin(angle), phase, amplitude])


def _ray_cast(camera: Camera, T: Floats, waves: Floats) -> Floats:
    """Return the depth image, m, by Newton steps along each ray."""
    rays = camera.rays().reshape(-1, 3) @ T[:3, :3].T
    depth = -T[2, 3] / rays[:, 2]
    for _ in range(20):
        p = T[:3, 3] + depth[:, None] * rays
        z, along_x, along_y = np.zeros((3, len(p)))
        for kx, ky, phase, amplitude in waves:
            angle = kx * p[:, 0] + ky * p[:, 1] + phase
            z += amplitude * np.sin(angle)
            slope = amplitude * np.cos(angle)
            along_x += kx * slope
            along_y += ky * slope
        # a ray nearly along the surface must not jump
        fall = np.minimum(rays[:, 2] - along_x * rays[:, 0] - along_y * rays[:, 1], -0.3)
        step = (p[:, 2] - z) / fall
        depth = depth - step
        if np.abs(step).max() < 1e-10:
            return np.asarray(depth.reshape(camera.height, camera.width))
    raise AssertionError("a ray did not settle on the relief")
