"""Pixels that come back empty: grazing views, dark surfaces, mirror images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sim.noise.shot import Image, Shot
from sim.noise.window import windowed
from sim.rendering.shading import Lighting
from sim.sensors import DepthSensor

Array = NDArray[np.float64]

POWER = 4
"""How sharply holes set in around the half-way values."""

_SELDOM = -2.5


@dataclass(frozen=True)
class Dropout:
    """Holes, in blotches of the matching window's size, with the probability of `hole_share`."""

    name: str = "dropout"
    is_noise: bool = True
    per_frame: bool = True

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""
        angle = np.degrees(np.arccos(sensor.dropout_cosine))
        return f"half lost at {angle:.0f}° or {100 * sensor.dropout_return:g} % return; glare"

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Make holes."""
        draw = windowed(rng, depth.shape, shot.sensor.window)
        share = hole_share(shot)
        # A draw's quantile, ndtr, is uniform and as smooth as the draws. It is dear, and for most
        # pixels it is plain that it lies above the share.
        close = np.flatnonzero((draw < _SELDOM) | (share > ndtr(_SELDOM)))
        out = depth.copy()
        out.flat[close[ndtr(draw.flat[close]) < share.flat[close]]] = np.nan
        return out


def hole_share(shot: Shot) -> Image:
    """The probability (height, width) that a pixel has no measurement.

    Three causes, independent of each other: a grazing view, at an incidence t with
    1 / (1 + (cos t / dropout_cosine)^4); too little light back, with the return
    reflectance (1 - gloss)^2 cos t, since gloss sends the rest elsewhere, in the same form; and
    blinding by the light's mirror image, gloss exp(-(a / glare)^2) at an angle a between the
    normal and the mirror direction.
    """
    sensor, geom = shot.sensor, shot.hits.geom
    finish = shot.finish
    diffuse = (finish.reflectance * (1.0 - finish.gloss) ** 2).astype(np.float32)
    keep = 1.0 - _falls_short(shot.cosine, sensor.dropout_cosine)
    keep *= 1.0 - _falls_short(diffuse[geom] * shot.cosine, sensor.dropout_return)
    shiny = np.flatnonzero((finish.gloss[geom] > 0.0) & (geom >= 0))
    if len(shiny):
        angle = _off_mirror(shot, shiny)
        blinding = finish.gloss[geom.ravel()[shiny]] * np.exp(-((angle / sensor.glare) ** 2))
        keep.flat[shiny] *= 1.0 - blinding
    return np.asarray(1.0 - keep, np.float32)


def _falls_short(value: Image, half: float) -> Image:
    ratio = value / np.float32(half)
    return np.asarray(1.0 / (1.0 + (ratio * ratio) ** (POWER // 2)), np.float32)


def _off_mirror(shot: Shot, pixels: NDArray[np.int64]) -> Array:
    """Angles (n,) between the normals at pixels and those that would mirror the light, rad.

    The light is the projector; without one, the lamp that the scene is painted with.
    """
    T = shot.T_world_camera
    v, u = np.divmod(pixels, shot.sensor.width)
    ray = np.einsum("ij,nj->ni", T[:3, :3], shot.rays(v, u))
    if shot.sensor.active:
        points = T[:3, 3] + ray * shot.hits.distance.ravel()[pixels, None]
        light = _unit(shot.eye - points)
    else:
        light = _unit(np.array(Lighting().towards, float))
    mirror = _unit(light - _unit(ray))
    normal = shot.scene.normals[shot.hits.triangle.ravel()[pixels]]
    # Normals point out of a surface, towards the camera; a thin sheet's may not.
    return np.arccos(np.minimum(np.abs(np.einsum("ni,ni->n", normal, mirror)), 1.0))


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
