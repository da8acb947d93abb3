"""What a frame's noise depends on: the sensor, the surfaces in view and the angles to them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sim.rendering.raycast import Hits, RayScene
from sim.rendering.shading import Finish
from sim.sensors import DepthSensor

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Indices = NDArray[np.int64]


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

    def rays(self, v: Indices, u: Indices) -> Array:
        """Viewing rays (n, 3) of the pixels in rows v and columns u, with z = 1, camera frame."""
        camera = self.sensor.camera
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        return np.column_stack([x, y, np.ones(len(x))])

    @property
    def eye(self) -> Array:
        """(3,) the second eye, or the projector, world frame."""
        T = self.T_world_camera
        return np.asarray(T[:3, 3] + self.sensor.baseline * T[:3, 0])

    @cached_property
    def cosine(self) -> Image:
        """(height, width) of the angle between viewing ray and surface normal; 1 at a miss."""
        cosine = self.scene.incidence(self.sensor.camera, self.T_world_camera, self.hits)
        cosine[self.hits.triangle < 0] = 1.0
        return np.minimum(cosine, 1.0).astype(np.float32)
