"""What the sensor's range and its file format do to a depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.noise.shot import Shot
from sim.sensors import DepthSensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RangeLimits:
    """No measurement outside the sensor's range."""

    name: str = "range-limits"
    is_noise: bool = False
    per_frame: bool = True

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""
        return f"{sensor.depth_min:g} m to {sensor.depth_max:g} m"

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Drop depths outside depth_min to depth_max."""
        inside = (depth >= shot.sensor.depth_min) & (depth <= shot.sensor.depth_max)
        return np.where(inside, depth, np.nan)


@dataclass(frozen=True)
class Quantisation:
    """Whole counts of the sensor's depth scale."""

    name: str = "quantisation"
    is_noise: bool = False
    per_frame: bool = True

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""
        return f"whole counts of {1e3 * sensor.depth_scale:g} mm"

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Round to the nearest count."""
        return np.asarray(np.rint(depth / shot.sensor.depth_scale) * shot.sensor.depth_scale)
