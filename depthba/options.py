"""The options of a registration.

One dataclass is the argument, the command line and the saved file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal


@dataclass(frozen=True)
class Options:
    """How to register a dataset."""

    preset: Literal["default", "paper"] = "default"
    """default: range residual, robust, coarse to fine. paper: the formulation of the paper to the
    letter."""
    resolution: float | None = None
    """Finest map spacing, m. None: close to the spacing of the points (paper: four times that)."""
    init: str = "measured"
    """Where to start: measured, identity, pairwise (each frame searched for in its neighbours, for
    measured poses too far off to start from), or a file of poses in TUM format."""
    roi: tuple[float, float, float, float, float, float] | None = None
    """Region of interest xmin xmax ymin ymax zmin zmax in the map frame, m: points outside, at the
    start poses, are left out."""
    threads: int | None = None
    """Threads of the kernels. None: all cores."""
    smoothing: float | None = None
    """Weight of the smoothing term against one point. None: the preset's own."""
    priors: bool = True
    """The measured poses count as measurements, too. With --no-priors they are only where to start
    (the paper preset never takes them)."""
    fixed_pattern: bool = True
    """An error of the range that all frames share is solved for, too. With --no-fixed-pattern there
    is none (the paper preset never has one)."""
    prior_t: float | None = None
    """Standard deviation of the measured translations, m. None: the dataset's pose_noise, else 0.01
    (paper: no prior)."""
    prior_r: float | None = None
    """Standard deviation of the measured rotations, rad. None: the dataset's pose_noise, else 0.02
    (paper: no prior)."""
    depth_range: tuple[float, float] | None = None
    """Least and greatest depth that counts (z in the sensor frame), m."""
    every: int = 1
    """Take every n-th frame alone, from the first on."""
    mask: str | None = None
    """Image, of which pixels that are 0 are left out of every frame; or a folder of one image a
    frame, named as its depth image."""
    most_points: int | None = None
    """Of more points in all frames together, every so many are left out. None: all are taken."""
    max_iterations: int = 30
    """Limit for each level and phase."""
    time_limit: float | None = None
    """Seconds after which no further iteration begins; what was reached by then is judged and
    returned. None: no limit."""


def options_of(config: Mapping[str, Any]) -> Options:
    """Return the options that a run saved; those that this version does not know are left out."""
    known = {field.name for field in fields(Options)}
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in config.items()
        if key in known
    }
    return Options(**values)
