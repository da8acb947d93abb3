"""The depth sensors that can be simulated, each with where its numbers come from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from depthba.camera import Camera, RangeNoise
from depthba.errors import OptionError
from sim.errors import SimulationError


@dataclass(frozen=True)
class DepthSensor:
    """A depth sensor as its data sheet gives it."""

    model: str
    width: int
    height: int
    field_of_view: float
    """Horizontal, rad."""
    baseline: float
    """Between the camera and its second eye or projector (to the camera's right), m."""
    depth_scale: float
    """One count of the stored depth, m."""
    depth_min: float
    depth_max: float
    """Range limits, m."""
    noise: RangeNoise
    sources: tuple[tuple[str, str], ...]
    """(field, where its number comes from)."""

    def resized(self, width: int, height: int) -> DepthSensor:
        """The same sensor with another image size and the same horizontal field of view."""
        if width < 8 or height < 8:
            raise OptionError(f"size {width}x{height}: expected at least 8x8 pixels")
        return replace(self, width=width, height=height)

    @property
    def camera(self) -> Camera:
        """Its pinhole camera: square pixels, the principal point in the image's middle."""
        f = 0.5 * self.width / math.tan(0.5 * self.field_of_view)
        return Camera(
            self.width, self.height, f, f, 0.5 * (self.width - 1), 0.5 * (self.height - 1)
        )


SP1000 = DepthSensor(
    model="sp1000",
    width=1280,
    height=960,
    field_of_view=math.radians(60.0),
    baseline=0.3,
    depth_scale=5e-5,
    depth_min=1.0,
    depth_max=3.27,
    noise=RangeNoise(sigma_m=0.00032, at_m=3.0, power=2.0, along="range"),
    sources=(
        (
            "noise",
            "0.32 mm at 3 m from the maker's public data, read as one sigma; it grows with z^2",
        ),
        ("width, height, field_of_view, baseline", "assumed: not in the public data"),
        ("depth_min, depth_max", "assumed: the working distance is 3 m"),
        ("depth_scale", "chosen so that 16 bits reach past depth_max"),
    ),
)

SENSORS: dict[str, DepthSensor] = {sensor.model: sensor for sensor in (SP1000,)}


def find_sensor(name: str) -> DepthSensor:
    """The sensor called `name`; SimulationError lists the choices."""
    try:
        return SENSORS[name]
    except KeyError:
        choices = ", ".join(sorted(SENSORS))
        raise SimulationError(f"unknown sensor {name!r}; choose one of: {choices}") from None
