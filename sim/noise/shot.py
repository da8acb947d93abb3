"""What a frame's noise depends on: the sensor, the surfaces in view and the angles to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.raycast import Hits, RayScene
from sim.sensors import DepthSensor
from sim.shading import Finish

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shot:
    """What the stages may look at, beside the depth that they change."""

    sensor: DepthSensor
    scene: RayScene
    finish: Finish
    T_world_camera: Array
    """(4, 4), the true one."""
    hits: Hits
    """What the pixels' rays met: of shape (height, width)."""

    @property
    def rays(self) -> Array:
        """(height, width, 3) viewing rays with z = 1, camera frame."""
        return self.sensor.camera.rays()
