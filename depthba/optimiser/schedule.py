"""How fine the map is, level by level, and which residual each preset takes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.errors import OptionError
from depthba.optimiser.linearise import Loss
from depthba.optimiser.problem import Problem
from depthba.options import Options

# Slope that noise alone may put into the map: above it the gradient, and with it the poses, are
# biased.
NOISE_SLOPE = 0.05
# The finest map's spacing, in point spacings, where noise allows: any finer, and single points
# decide a cell.
FINEST = 1.2
# The coarsest cells are this many times the distance by which the start poses may displace a point.
REACH = 1.5
# Points of one frame on a node, of which more add little before the finest level.
ENOUGH = 6
# A map of fewer nodes than this across is no map.
FEWEST = 12
# The robust loss begins this wide, in robust standard deviations: far stray points are checked, the
# rest is not.
WIDE = 12.0


@dataclass(frozen=True)
class Preset:
    """What a preset fixes; see :class:`depthba.options.Options`."""

    along_ray: bool
    slope: bool
    robust: float
    smoothing: float
    relative: bool
    """Smoothing is relative to the data on a typical node; else it is against one point."""
    whole: bool
    """Smoothing ties all nodes of the grid; else those near a seen one."""
    prior: bool
    """The measured poses enter as residuals."""
    pattern: bool
    """A fixed pattern of the camera is solved for."""

    def phases(self, index: int) -> tuple[str, ...]:
        """Return the losses of a level.

        The robust one comes only when the poses have settled under a wide one.
        """
        if not self.robust:
            return ("quadratic",)
        return ("quadratic", "robust") if index == 0 else ("robust",)

    def scale(self, phase: str) -> float:
        """Return a phase's robust scale, in robust standard deviations; 0 without such a loss."""
        if not self.robust:
            return 0.0
        return self.robust if phase == "robust" else WIDE


PRESETS = {
    "paper": Preset(
        along_ray=False, slope=False, robust=0.0,
        smoothing=0.1, relative=False, whole=True, prior=False, pattern=False,
    ),
    "default": Preset(
        along_ray=True, slope=True, robust=3.5,
        smoothing=1e-4, relative=True, whole=False, prior=True, pattern=True,
    ),
}  # fmt: skip


def preset_of(options: Options) -> Preset:
    """Return what the options' preset fixes."""
    preset = PRESETS[options.preset]
    return replace(
        preset,
        prior=preset.prior and options.priors,
        pattern=preset.pattern and options.fixed_pattern,
    )


def check(options: Options) -> None:
    """Refuse values that make no sense.

    Raises:
        OptionError: names the option, its value and what was expected.
    """
    if options.preset not in PRESETS:
        raise OptionError(f"--preset {options.preset}: expected one of {', '.join(PRESETS)}")
    for name in ("resolution", "prior_t", "prior_r", "time_limit"):
        value = getattr(options, name)
        if value is not None and not (np.isfinite(value) and value > 0):
            raise OptionError(f"--{name.replace('_', '-')} {value:g}: expected a number above 0")
    if options.smoothing is not None and not (
        np.isfinite(options.smoothing) and options.smoothing > 0
    ):
        raise OptionError(f"--smoothing {options.smoothing:g}: expected a number above 0")
    for name in ("threads", "most_points", "max_iterations"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise OptionError(f"--{name.replace('_', '-')} {value}: expected 1 or more")


def finest_spacing(problem: Problem, deviation: float | None = None) -> float:
    """Return the map spacing that the data call for, m.

    Near the spacing of the points, but no finer than noise allows: n points of deviation sigma on a
    cell of size s leave a slope of sigma / (s sqrt(n)) in the map, and n grows with s^2 times the
    points' density. ``deviation`` is what an independent point of as little knowledge would have,
    m, as far as the residuals have shown it; None: the stated noise.
    """
    deviation = problem.noise if deviation is None else deviation
    if deviation is None:
        return 4 * problem.spacing
    area = float(np.prod(problem.upper - problem.lower))
    density = sum(len(f) for f in problem.frames) / max(area, 1e-12)
    by_noise = float(np.sqrt(deviation / NOISE_SLOPE / np.sqrt(density)))
    return max(FINEST * problem.spacing, by_noise)


def spacings(
    options: Options, problem: Problem, sigma_t: NDArray[np.float64], sigma_r: NDArray[np.float64]
) -> list[float]:
    """Return the map spacing of each level, coarse to fine, m."""
    finest = options.resolution or finest_spacing(problem)
    if options.preset == "paper":
        return [options.resolution or 4 * finest]
    displaced = float(np.hypot(sigma_t.max(), sigma_r.max() * problem.ranges))
    widest = min(problem.upper - problem.lower) / FEWEST
    levels = [finest]
    while levels[0] < REACH * displaced and 2 * levels[0] < widest:
        levels.insert(0, 2 * levels[0])
    return levels


def stride(problem: Problem, spacing: float) -> int:
    """Return which share of the points a level needs.

    Every how-manieth one leaves a frame enough on a node.
    """
    return max(1, int((spacing / problem.spacing) ** 2 / ENOUGH))


def loss_for(
    preset: Preset, options: Options, problem: Problem, spacing: float, data: float
) -> Loss:
    """Return the residual of a level; ``data`` is the weight of the points on a typical node."""
    smoothing = options.smoothing if options.smoothing is not None else preset.smoothing
    return Loss(
        along_ray=preset.along_ray and problem.origin,
        slope=preset.slope,
        robust_c=0.0,
        cap=2 * spacing,
        charge=0.0,
        smoothing=smoothing * (data if preset.relative and options.smoothing is None else 1.0),
    )
