"""What a stage of the noise is."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim.noise.shot import Shot
from sim.sensors import DepthSensor

Array = NDArray[np.float64]


class Stage(Protocol):
    """One fault of a sensor.

    It draws a number for every pixel, holes too, so that one more hole leaves the rest as it was.
    """

    @property
    def name(self) -> str:
        """What the command line and the random stream call it."""

    @property
    def is_noise(self) -> bool:
        """True where `--clean` leaves it out; False for what the file format does anyway."""

    @property
    def per_frame(self) -> bool:
        """Whether each frame has draws of its own; False: all frames of a dataset share them."""

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """The depth (height, width) m after this stage; NaN where there is no measurement."""
