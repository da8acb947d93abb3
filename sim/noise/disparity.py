"""Errors of the disparity d = f B / z: they move the depth by z^2 / (f B) each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.noise.shot import Image, Shot
from sim.noise.window import windowed
from sim.sensors import DepthSensor

Array = NDArray[np.float64]

STEEPEST = float(np.radians(85.0))
"""Incidence beyond which the noise grows no more."""

WAVES = 6
"""Half waves across the image, both ways together, that the fixed pattern goes up to."""


def shift_disparity(depth: Array, sensor: DepthSensor, error: Image | Array) -> Array:
    """The depth (height, width) m whose disparity is off by `error`, pixels."""
    return np.asarray(depth / (1.0 + depth * (error / sensor.disparity_at_1m)))


def step_sigma(sensor: DepthSensor) -> float:
    """Standard deviation that rounding to the sub-pixel step adds, pixels."""
    return (sensor.disparity_step or 0.0) / np.sqrt(12.0)


def random_sigma(sensor: DepthSensor) -> float:
    """What the sensor's noise leaves to chance beside its steps and its pattern, pixels."""
    return float(np.sqrt(sensor.disparity_sigma**2 - step_sigma(sensor) ** 2 - sensor.pattern**2))


@dataclass(frozen=True)
class FixedPattern:
    """A slowly varying bias of the disparity, the same in every frame.

    Its mean and its linear parts are gone, since calibration takes those out; its rms over the
    image is the sensor's `pattern`.
    """

    name: str = "fixed-pattern"
    is_noise: bool = True
    per_frame: bool = False

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""
        return f"smooth bias of {sensor.pattern:.2g} px rms, the same in all frames"

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Add the pattern."""
        field = shot.sensor.pattern * smooth_field(rng, depth.shape)
        return shift_disparity(depth, shot.sensor, field)


def smooth_field(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """A few random cosine waves across the image: rms 1, without constant and linear parts.

    Equal draws give the same field at any image size.
    """
    wave = np.arange(WAVES + 1)
    weight = rng.standard_normal((WAVES + 1, WAVES + 1))
    weight[np.add.outer(wave, wave) > WAVES] = 0.0
    place = [(np.arange(n) + 0.5) / n for n in shape]
    basis = [np.cos(np.pi * np.multiply.outer(x, wave)) for x in place]
    rows = np.einsum("vp,pq->vq", basis[0], weight)
    # As a sum of whole images in single precision: quicker than a product this thin.
    field = np.einsum("vq,uq->vu", rows.astype(np.float32), basis[1].astype(np.float32))
    field -= field.mean()
    for axis, x in enumerate(place):
        centred = (x - 0.5).reshape((-1, 1) if axis == 0 else (1, -1))
        slope = np.mean(field * centred) / np.mean(centred**2)
        field -= slope * centred
    return np.asarray(field / np.sqrt(np.mean(field**2)))


@dataclass(frozen=True)
class DisparityNoise:
    """Gaussian noise of the disparity, alike over a matching window (Khoshelham & Elberink 2012).

    It is what the sensor's stated noise has beyond its steps and its pattern.
    """

    name: str = "disparity-noise"
    is_noise: bool = True
    per_frame: bool = True

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""
        return (
            f"σ_z = z²/(f·B)·σ_d, σ_d = {random_sigma(sensor):.3g} px,"
            f" window {max(sensor.window, 1.0):.3g} px"
        )

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Shift every disparity."""
        error = windowed(rng, depth.shape, shot.sensor.window)
        error *= np.float32(random_sigma(shot.sensor))
        return shift_disparity(depth, shot.sensor, error)


@dataclass(frozen=True)
class Grazing:
    """Noise grows where the surface turns away (form of Nguyen et al. 2012).

    This stage adds what the disparity's noise lacks of sigma (1 + k t^2 / (pi/2 - t)^2) at
    incidence t.
    """

    name: str = "grazing"
    is_noise: bool = True
    per_frame: bool = True

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""
        return f"σ grows to σ·(1 + {sensor.grazing:g} θ²/(π/2-θ)²) at incidence θ"

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Shift disparities by the noise that the incidence adds."""
        error = windowed(rng, depth.shape, shot.sensor.window)
        factor = grazing_factor(shot.cosine, shot.sensor.grazing)
        error *= np.float32(random_sigma(shot.sensor)) * np.sqrt(factor**2 - np.float32(1.0))
        return shift_disparity(depth, shot.sensor, error)


def grazing_factor(cosine: Image, growth: float) -> Image:
    """By how much the noise is larger than on a surface that faces the camera, 1 or more."""
    t = np.minimum(np.arccos(cosine), np.float32(STEEPEST))
    return np.asarray(1.0 + growth * (t / (0.5 * np.pi - t)) ** 2, np.float32)


@dataclass(frozen=True)
class DisparitySteps:
    """Matching finds the disparity in steps of a fraction of a pixel."""

    name: str = "disparity-steps"
    is_noise: bool = True
    per_frame: bool = True

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""
        if sensor.disparity_step is None:
            return "none: the disparity is continuous"
        return f"disparity in steps of {sensor.disparity_step:.3g} px"

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Round the disparity; nothing where the sensor has no steps."""
        step = shot.sensor.disparity_step
        if step is None:
            return depth
        unit = shot.sensor.disparity_at_1m / step
        # Nearer than half a step to infinity nothing is measured.
        count = np.rint(unit / depth)
        return np.asarray(np.divide(unit, count, out=np.full_like(depth, np.nan), where=count > 0))
