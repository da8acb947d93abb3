"""The sensor that took the frames, and how far the measured poses are trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from depthba.camera import Camera, RangeNoise

DEPTH_LARGEST = 65535
"""Largest pixel of a depth image."""


@dataclass(frozen=True)
class Sensor:
    """The sensor that took the frames."""

    kind: Literal["depth", "cloud"]
    """``depth``: images of z. ``cloud``: points."""
    model: str
    """Name, "" where unknown."""
    camera: Camera | None
    """Size and intrinsics; None for clouds."""
    depth_scale: float | None
    """Metres per step of a depth image; None for clouds."""
    depth_min: float | None
    """Smallest z that counts, metres."""
    depth_max: float | None
    """Largest z that counts, metres."""
    noise: RangeNoise | None
    """None where unknown."""
    origin: bool
    """Whether the rays start at the origin of the sensor frame; always so for depth images."""


@dataclass(frozen=True)
class HandEyeNoise:
    """Believed standard deviation of a hand-eye transform, per axis of the camera."""

    sigma_t_m: tuple[float, float, float]
    """Metres."""
    sigma_r_rad: tuple[float, float, float]
    """Radians."""


@dataclass(frozen=True)
class PoseNoise:
    """Believed standard deviation of the measured poses, per axis of the world."""

    sigma_t_m: tuple[float, float, float]
    """Metres."""
    sigma_r_rad: tuple[float, float, float]
    """Radians."""
    hand_eye: HandEyeNoise | None = None
    """Of what all poses share beside: an error of the hand-eye transform; None: stated above."""
