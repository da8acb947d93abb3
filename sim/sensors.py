"""The depth sensors that can be simulated, each with where its numbers come from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from depthba.camera import Camera, RangeNoise
from depthba.errors import OptionError
from sim.errors import SimulationError


@dataclass(frozen=True)
class DepthSensor:
    """A triangulating depth sensor: its data sheet, and the constants of its faults.

    Pixels are those of `width` x `height`; `resized` scales them, so that every fault stays as
    large in metres.
    """

    model: str
    width: int
    height: int
    field_of_view: float
    """Horizontal, rad."""
    baseline: float
    """From the camera to its second eye or projector, along camera +x, m."""
    active: bool
    """What stands at the baseline's other end.

    True: a projector that lights all that the camera sees, and whose mirror image blinds it. False:
    a second camera like the first, which misses a strip at the image's left border."""
    depth_scale: float
    """One count of the stored depth, m."""
    depth_min: float
    depth_max: float
    """Range limits, m."""
    noise: RangeNoise
    """Standard deviation on a matt surface that faces the camera, all stages together."""
    window: float
    """Width of the window over which the disparity's noise is one, pixels."""
    disparity_step: float | None
    """Step of the sub-pixel disparity, pixels. None: continuous, as a phase is."""
    pattern: float
    """Rms over the image of the disparity's fixed pattern, pixels."""
    lateral: float
    """Standard deviation of where outlines appear, pixels."""
    flying: float
    """Width of the footprint that mixes what lies on both sides of an outline, pixels."""
    grazing: float
    """Growth k of the noise at incidence t: by the factor 1 + k t^2 / (pi/2 - t)^2."""
    dropout_cosine: float
    """Cosine of the incidence at which half of the pixels have no measurement."""
    dropout_return: float
    """Returned light at which half of the pixels have none; a white surface seen straight: 1."""
    glare: float
    """Angle between normal and mirror direction at which blinding has fallen to 1/e, rad."""
    sources: tuple[tuple[str, str], ...]
    """(fields, where their numbers come from)."""

    def resized(self, width: int, height: int) -> DepthSensor:
        """The same sensor with another image size and the same horizontal field of view."""
        if width < 8 or height < 8:
            raise OptionError(f"size {width}x{height}: expected at least 8x8 pixels")
        k = width / self.width
        return replace(
            self,
            width=width,
            height=height,
            window=k * self.window,
            disparity_step=None if self.disparity_step is None else k * self.disparity_step,
            pattern=k * self.pattern,
            lateral=k * self.lateral,
            flying=k * self.flying,
        )

    def noisier(self, factor: float) -> DepthSensor:
        """The same sensor with all errors of its disparity larger by a factor."""
        if factor == 1.0:
            return self
        return replace(
            self,
            noise=replace(self.noise, sigma_m=factor * self.noise.sigma_m),
            disparity_step=None if self.disparity_step is None else factor * self.disparity_step,
            pattern=factor * self.pattern,
        )

    @property
    def camera(self) -> Camera:
        """Its pinhole camera: square pixels, the principal point in the image's middle."""
        f = self.focal
        return Camera(
            self.width, self.height, f, f, 0.5 * (self.width - 1), 0.5 * (self.height - 1)
        )

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return 0.5 * self.width / math.tan(0.5 * self.field_of_view)

    @property
    def disparity_at_1m(self) -> float:
        """Focal length times baseline, pixels x m: over the depth it is the disparity."""
        return self.focal * self.baseline

    @property
    def disparity_sigma(self) -> float:
        """What `noise` comes to in disparity, pixels: sigma_z = z^2 / (f B) sigma_d."""
        return self.noise.sigma_m * self.disparity_at_1m / self.noise.at_m**2


SP1000 = DepthSensor(
    model="sp1000",
    width=1280,
    height=960,
    field_of_view=math.radians(60.0),
    baseline=0.3,
    active=True,
    depth_scale=5e-5,
    depth_min=1.0,
    depth_max=3.27,
    noise=RangeNoise(sigma_m=0.00032, at_m=3.0, power=2.0, along="z"),
    window=1.75,
    disparity_step=None,
    pattern=0.0011,
    lateral=0.3,
    flying=1.0,
    grazing=0.05,
    dropout_cosine=0.12,
    dropout_return=0.03,
    glare=0.10,
    sources=(
        (
            "noise",
            "0.32 mm at 3 m from the maker's public data, read as one sigma; it grows with z^2 and"
            " lies along z, as triangulation has it (Khoshelham & Elberink 2012)",
        ),
        ("width, height, field_of_view, baseline", "assumed: not in the public data"),
        ("depth_min, depth_max", "assumed: the working distance is 3 m"),
        ("depth_scale", "chosen so that 16 bits reach past depth_max"),
        ("active, disparity_step", "structured light; phase shifts assumed, so no steps"),
        ("window", "assumed: the phase of one pixel, smoothed lightly"),
        ("pattern", "assumed: calibrated for metrology, 0.03 mm rms at 3 m"),
        ("lateral", "assumed: under half of the 0.8 px of a Kinect in Nguyen et al. 2012"),
        ("flying", "assumed: what one pixel's footprint sees"),
        ("grazing", "form of Nguyen et al. 2012, whose Kinect has 0.05 at 1 m"),
        ("dropout_cosine, dropout_return, glare", "assumed: 83 deg, 3 % and 6 deg"),
    ),
)

ZED2 = DepthSensor(
    model="zed2",
    width=1280,
    height=720,
    field_of_view=2.0 * math.atan(640.0 / 528.0),
    baseline=0.12,
    active=False,
    depth_scale=1e-4,
    depth_min=0.2,
    depth_max=6.5,
    noise=RangeNoise(sigma_m=0.0016, at_m=1.0, power=2.0, along="z"),
    window=7.0,
    disparity_step=0.0625,
    pattern=0.03,
    lateral=0.8,
    flying=3.0,
    grazing=0.05,
    dropout_cosine=0.10,
    dropout_return=0.01,
    glare=0.10,
    sources=(
        ("width, height, baseline", "maker's data: 2 x 1280x720, 120 mm"),
        ("field_of_view", "f = 528 px, half of the 1056 px of the 1080p and 2.2K modes"),
        ("depth_min", "maker's data, 0.2 m"),
        ("depth_max, depth_scale", "16 bits of 0.1 mm; the maker states 20 m"),
        (
            "noise",
            "maker's data: depth error under 1 % up to 3 m; 0.1 px (assumed) is 0.16 % at 1 m and"
            " 0.48 % at 3 m as one sigma (Khoshelham & Elberink 2012)",
        ),
        ("window", "assumed: block matching over 7 x 7 px"),
        ("disparity_step", "assumed: 1/16 px, as usual for block matching"),
        ("pattern", "assumed: what rectification leaves, 0.03 px rms, 0.5 mm at 1 m"),
        ("lateral", "0.8 px as a Kinect's (Nguyen et al. 2012), assumed alike"),
        ("flying", "assumed: the inner part of the window"),
        ("grazing", "form of Nguyen et al. 2012, whose Kinect has 0.05 at 1 m"),
        ("dropout_cosine, dropout_return, glare", "assumed: 84 deg, 1 % and 6 deg"),
    ),
)

SENSORS: dict[str, DepthSensor] = {sensor.model: sensor for sensor in (SP1000, ZED2)}


def find_sensor(name: str) -> DepthSensor:
    """The sensor called `name`; SimulationError lists the choices."""
    try:
        return SENSORS[name]
    except KeyError:
        choices = ", ".join(sorted(SENSORS))
        raise SimulationError(f"unknown sensor {name!r}; choose one of: {choices}") from None
