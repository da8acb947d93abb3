"""The noise of theory: independent Gaussian errors of the range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.noise.shot import Shot
from sim.sensors import DepthSensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WhiteNoise:
    """Gaussian noise along the ray, every pixel for itself, of the sensor's sigma at its depth."""

    name: str = "white-noise"
    is_noise: bool = True
    per_frame: bool = True

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""
        noise = sensor.noise
        return (
            f"σ = {1e3 * noise.sigma_m:.3g} mm·(z / {noise.at_m:g} m)^{noise.power:g} along the ray"
        )

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Move every point along its ray."""
        camera = shot.sensor.camera
        error = shot.sensor.noise.sigma(depth) * rng.standard_normal(depth.shape)
        return np.asarray(depth + error / np.linalg.norm(camera.rays(), axis=-1))
