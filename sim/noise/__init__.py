"""What a sensor does to exact depth: a row of named stages, each with its own seed and switch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim.errors import SimulationError
from sim.noise.shot import Shot
from sim.seeds import stream

Array = NDArray[np.float64]


class Stage(Protocol):
    """One fault of a sensor."""

    @property
    def name(self) -> str:
        """What the command line and the random stream call it."""

    @property
    def is_noise(self) -> bool:
        """True where `--clean` leaves it out; False for what the file format does anyway."""

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """The depth (height, width) m after this stage; NaN where there is no measurement."""


@dataclass(frozen=True)
class RangeJitter:
    """Independent Gaussian noise of every pixel, along the ray or along z, as the sensor says."""

    name: str = "range-noise"
    is_noise: bool = True

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Shift every depth by a draw of the sensor's sigma at that depth."""
        # Drawn for holes too, so that one more hole leaves the other pixels' noise as it was.
        error = shot.sensor.noise.sigma(depth) * rng.standard_normal(depth.shape)
        if shot.sensor.noise.along == "range":
            error /= np.linalg.norm(shot.rays, axis=-1)
        return np.asarray(depth + error)


@dataclass(frozen=True)
class RangeLimits:
    """No measurement outside the sensor's range."""

    name: str = "range-limits"
    is_noise: bool = False

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Drop depths outside depth_min to depth_max."""
        inside = (depth >= shot.sensor.depth_min) & (depth <= shot.sensor.depth_max)
        return np.where(inside, depth, np.nan)


@dataclass(frozen=True)
class Quantisation:
    """Whole counts of the sensor's depth scale."""

    name: str = "quantisation"
    is_noise: bool = False

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Round to the nearest count."""
        return np.asarray(np.rint(depth / shot.sensor.depth_scale) * shot.sensor.depth_scale)


STAGES: tuple[Stage, ...] = (RangeJitter(), RangeLimits(), Quantisation())


def choose_stages(clean: bool = False, without: tuple[str, ...] = ()) -> tuple[Stage, ...]:
    """The stages in their order, less the noise (`clean`) and those named in `without`.

    SimulationError lists the names where one is unknown.
    """
    names = [stage.name for stage in STAGES]
    for name in without:
        if name not in names:
            raise SimulationError(f"unknown noise stage {name!r}; choose from: {', '.join(names)}")
    return tuple(s for s in STAGES if s.name not in without and not (clean and s.is_noise))


def measure(
    depth: Array, shot: Shot, seed: int, frame: int, stages: tuple[Stage, ...] = STAGES
) -> Array:
    """What the sensor reports of the exact depth (height, width) m of a frame; NaN: nothing."""
    for stage in stages:
        depth = stage(depth, shot, stream(seed, "noise", stage.name, frame))
    return depth
