"""What to vary of a scene's dataset."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from depthba.errors import OptionError


@dataclass(frozen=True)
class GenerateOptions:
    """What to vary of a scene's dataset. Equal options give equal bytes."""

    seed: int = 0
    """Arrangement, noise and pose errors."""
    frames: int | None = None
    """Number of frames. None: the rig's own (industrial scenes: 21)."""
    size: tuple[int, int] | None = None
    """Image width and height, pixels. None: the sensor's own (SP1000: 1280 x 960)."""
    start_error: tuple[float, float] | None = None
    """Instead of the rig's pose errors: independent Gaussian errors per axis; frame 0 is exact.

    The standard deviations, m and rad."""
    clean: bool = False
    """Leave all noise out, of the depth and of the poses; start_error still counts."""
    pose_noise: float = 1.0
    """Factor on the rig's pose errors."""
    depth_noise: float = 1.0
    """Factor on the errors of the sensor's disparity: its sigma, steps and fixed pattern."""
    white: bool = False
    """For studies: the sensor's sigma along the ray, each pixel for itself, and no other fault."""
    without: tuple[str, ...] = ()
    """Stages of the sensor's noise to leave out, by name."""
    sensor: str | None = None
    """Another sensor than the scene's, by name."""
    rig: str | None = None
    """Another rig than the scene's, by name."""
    renderer: Literal["rays", "mujoco"] = "rays"
    """`mujoco` takes depth and colour from MuJoCo's own OpenGL renderer, as a cross-check."""
    settled: bool = False
    """Let loose bodies come to rest under physics before the capture. Takes minutes."""
    rgb: bool = True
    """Whether to render colour images too."""

    def __post_init__(self) -> None:
        """OptionError names a value that makes no sense."""
        if self.seed < 0:
            raise OptionError(f"seed {self.seed}: expected 0 or more")
        if self.frames is not None and self.frames < 1:
            raise OptionError(f"frames {self.frames}: expected 1 or more")
        if self.renderer not in ("rays", "mujoco"):
            raise OptionError(f"renderer {self.renderer!r}: expected rays or mujoco")
        if not (math.isfinite(self.pose_noise) and self.pose_noise >= 0.0):
            raise OptionError(f"pose_noise {self.pose_noise}: expected a factor of 0 or more")
        if not (math.isfinite(self.depth_noise) and self.depth_noise > 0.0):
            raise OptionError(
                f"depth_noise {self.depth_noise}: expected a factor above 0 (clean leaves all out)"
            )


DEFAULTS = GenerateOptions()
"""A scene as its rig and its sensor capture it."""
