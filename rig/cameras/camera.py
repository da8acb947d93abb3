"""The interface of a depth camera.

A user adds one with a class like this and an entry point of the group ``depthba.cameras``; see
`rig.cameras.finding`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera


@dataclass(frozen=True)
class CameraInfo:
    """What a camera is, as dataset.json's sensor states it."""

    model: str
    serial: str
    camera: Camera
    """Of the depth image; colour is aligned to it."""
    depth_scale: float = 1e-4
    """Metres per count of a stored depth image."""
    depth_min: float | None = None
    depth_max: float | None = None
    """What the camera can measure, m; None: not known."""
    noise: tuple[float, float, float] | None = None
    """sigma_m, at_m and power of the range's standard deviation; None: not known."""
    noise_along: Literal["range", "z"] = "range"
    """Whether that deviation is along the ray or along z, as dataset.json's sensor says it."""
    settings: dict[str, str | float | bool] = field(default_factory=dict)
    """What the camera was set to, for the dataset's record."""


@dataclass(frozen=True, eq=False)
class Capture:
    """One frame as a camera gave it."""

    depth: NDArray[np.float32]
    """(height, width) z, m; NaN where nothing was measured."""
    stamp: float
    """Host clock, s since the epoch, of the middle of the exposure as nearly as it is known."""
    rgb: NDArray[np.uint8] | None = None
    """(height, width, 3) or None."""
    T_world_camera_true: NDArray[np.float64] | None = None
    """(4, 4), which a simulation alone knows."""
    moment: float | None = None
    """`stamp` on the steady clock (`time.monotonic`), s. Cameras need not say it: whoever owns one
    does."""


def moment_of(stamp: float) -> float:
    """Return where on the steady clock a stamp of the wall clock lies, s; asked soon after it."""
    return time.monotonic() - (time.time() - stamp)


class DepthCamera(Protocol):
    """A depth camera. Raises `rig.errors.CameraError` or one of its kinds, nothing else."""

    def open(self) -> CameraInfo:
        """Reach the camera and start it. CameraError says what was found and what was expected."""

    def capture(self, timeout: float) -> Capture:
        """A frame whose exposure began after this call; CameraTimeout after `timeout` s."""

    def close(self) -> None:
        """Let go of the camera. Safe to call twice, and after a failure."""
