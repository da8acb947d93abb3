"""What a sensor does to exact depth: a row of named stages, each with its own seed and switch.

The order is that of the causes: what both eyes see, where outlines fall, the disparity and its
errors, what is given up as unreliable, what is stored.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from depthba.camera import RangeNoise
from sim.errors import SimulationError
from sim.noise.disparity import (
    DisparityNoise,
    DisparitySteps,
    FixedPattern,
    Grazing,
    random_sigma,
    step_sigma,
)
from sim.noise.dropout import Dropout
from sim.noise.outlines import FlyingPixels, LateralJitter, Shadow
from sim.noise.shot import Shot
from sim.noise.stage import Stage
from sim.noise.storage import Quantisation, RangeLimits
from sim.noise.white import WhiteNoise
from sim.seeds import stream
from sim.sensors import DepthSensor

Array = NDArray[np.float64]

STAGES: tuple[Stage, ...] = (
    Shadow(),
    LateralJitter(),
    FlyingPixels(),
    FixedPattern(),
    DisparityNoise(),
    Grazing(),
    DisparitySteps(),
    Dropout(),
    RangeLimits(),
    Quantisation(),
)

WHITE: tuple[Stage, ...] = (WhiteNoise(), RangeLimits(), Quantisation())
"""For studies: the sensor's sigma, independent in every pixel, and nothing else."""


def choose_stages(
    clean: bool = False, without: tuple[str, ...] = (), white: bool = False
) -> tuple[Stage, ...]:
    """The stages in their order, less the noise (`clean`) and those named in `without`.

    `white` takes those of `WHITE`. SimulationError lists the names where one is unknown.
    """
    stages = WHITE if white else STAGES
    names = [stage.name for stage in stages]
    for name in without:
        if name not in names:
            raise SimulationError(f"unknown noise stage {name!r}; choose from: {', '.join(names)}")
    return tuple(s for s in stages if s.name not in without and not (clean and s.is_noise))


def measure(
    depth: Array, shot: Shot, seed: int, frame: int, stages: tuple[Stage, ...] = STAGES
) -> Array:
    """What the sensor reports of the exact depth (height, width) m of a frame; NaN: nothing."""
    measured = depth
    for _, after in _steps(depth, shot, seed, frame, stages):
        measured = after
    return measured


def staged(
    depth: Array, shot: Shot, seed: int, frame: int, stages: tuple[Stage, ...] = STAGES
) -> list[tuple[str, Array]]:
    """Like `measure`, but each stage's name with the depth after it, in order."""
    return list(_steps(depth, shot, seed, frame, stages))


def _steps(
    depth: Array, shot: Shot, seed: int, frame: int, stages: tuple[Stage, ...]
) -> Iterator[tuple[str, Array]]:
    for stage in stages:
        labels = (stage.name, frame) if stage.per_frame else (stage.name,)
        depth = stage(depth, shot, stream(seed, "noise", *labels))
        yield stage.name, depth


def stated_noise(sensor: DepthSensor, stages: tuple[Stage, ...] = STAGES) -> RangeNoise | None:
    """What a dataset may say of its noise: the sensor's, less what absent stages would add.

    None where nothing random is left of it.
    """
    parts = {
        "disparity-noise": random_sigma(sensor) ** 2,
        "disparity-steps": step_sigma(sensor) ** 2,
        "fixed-pattern": sensor.pattern**2,
    }
    names = [stage.name for stage in stages]
    if "white-noise" in names:
        return replace(sensor.noise, along="range")
    if "disparity-noise" not in names:
        return None
    absent = sum(part for name, part in parts.items() if name not in names)
    share = 1.0 - absent / sensor.disparity_sigma**2
    return replace(sensor.noise, sigma_m=sensor.noise.sigma_m * float(np.sqrt(share)))
