"""Hand-eye calibration without a board: X from depth and flange poses alone.

The map is solved with it, coarse to fine as in registration; then everything else that errs joins
in: the robot, and the camera's fixed pattern.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.dataset import Dataset
from depthba.errors import OptionError
from depthba.optimiser import schedule
from depthba.optimiser.bends import without_bends
from depthba.optimiser.level import level_heights, make_level
from depthba.optimiser.workers import Workers
from depthba.options import Options as MapOptions
from rig.hand_eye.depth.believed import Beliefs
from rig.hand_eye.depth.descent import Iteration, Start, descend
from rig.hand_eye.depth.joint import Joint, solve
from rig.hand_eye.depth.pattern import waves_of
from rig.hand_eye.depth.problem import set_up
from rig.hand_eye.depth.verdict import Status, judge
from rig.hand_eye.flanges import turned
from rig.hand_eye.record import Open

Array = NDArray[np.float64]

# The robust loss begins this wide, in robust standard deviations.
WIDE = 12.0
LIMIT = 40
# Change of slope of the map beyond which points take no part in the end: where more is kept the
# depths contradict the truth, where less is kept they leave the robot's own errors undecided.
SHARP = 2.0
# Of a joint's zero, rad, and of each wave of the fixed pattern, m, to begin with.
ZERO, PATTERN = 0.0005, 0.0001


@dataclass(frozen=True)
class Options:
    """How to calibrate from depth."""

    start_error: tuple[float, float] = (0.01, 1.0)
    """How far off the start may be along and about each axis: standard deviations, m and
    degrees."""
    robot_noise: tuple[float, float] = (0.00005, 0.01)
    """How well the robot repeats a flange pose: standard deviations along and about each axis, m
    and degrees. It is taken for worse where the depths say so."""
    resolution: float | None = None
    """Finest map spacing, m. None: what noise and spacing of the points call for."""
    threads: int | None = None
    """Threads of the kernels. None: all cores."""


@dataclass(frozen=True)
class HandEye:
    """A hand-eye transform, how certain it is, and whether to rely on it."""

    status: Status
    reason: str
    """One sentence for people."""
    T_flange_camera: Array
    """(4, 4), estimated."""
    T_flange_camera_start: Array
    """(4, 4)."""
    covariance: Array
    """(6, 6), translation along the flange's axes then rotation about them, m and rad, left
    perturbation about the camera centre."""
    open: tuple[Open, ...]
    """Directions that the data leave to the start."""
    turned: Array
    """(3,) rad, by how much the flange turned between frames (root mean square) about three axes,
    the largest first."""
    missed: Array
    """(N, 6), by which each flange is thought to be elsewhere than reported, base axes, m and
    rad."""
    residuals: Array
    """(N,) robust standard deviation of each frame's residuals, m."""
    zeros: Array
    """(n,), by which the joints' zeros are thought to be off, rad."""
    beliefs: Beliefs
    """How much each kind of error is thought to scatter."""
    inflation: float
    """Factor by which the residuals' correlation inflates their variance."""
    sigma: float
    """Robust standard deviation of the residuals, m."""
    spacing: float
    """Finest map spacing, m."""
    iterations: int
    seconds: float

    @property
    def trusted(self) -> bool:
        """Whether the exit status is 0 (else 3: finished, but not to be trusted)."""
        return self.status == "converged"


def check(options: Options) -> None:
    """Refuse values that make no sense.

    Raises:
        OptionError: names the option, its value and what was expected.
    """
    for name in ("start_error", "robot_noise"):
        value = getattr(options, name)
        if not all(np.isfinite(v) and v > 0 for v in value):
            shown = " ".join(f"{v:g}" for v in value)
            raise OptionError(
                f"--{name.replace('_', '-')} {shown}: expected two numbers above 0, m and degrees"
            )
    if options.resolution is not None and not (
        np.isfinite(options.resolution) and options.resolution > 0
    ):
        raise OptionError(f"--resolution {options.resolution:g}: expected a number above 0")
    if options.threads is not None and options.threads < 1:
        raise OptionError(f"--threads {options.threads}: expected 1 or more")


def calibrate(
    dataset: Dataset,
    T_flange_camera: Array,
    options: Options | None = None,
    callback: Callable[[Iteration], None] | None = None,
) -> HandEye:
    """Estimate the hand-eye transform of a dataset with flange poses.

    Args:
        dataset: frames of one scene, each with the flange pose that the robot reported.
        T_flange_camera: (4, 4), the start.
        options: how; the defaults where None.
        callback: called after every iteration.

    Raises:
        DatasetError: the dataset is damaged, has fewer than 3 frames, or one without flange pose.
        OptionError: an option makes no sense.
    """
    options = options or Options()
    check(options)
    begin = time.perf_counter()
    workers = Workers(options.threads or os.cpu_count() or 1)
    count = 0

    def report(iteration: Iteration) -> None:
        nonlocal count
        count += 1
        if callback is not None:
            callback(iteration)

    try:
        joint, spacing, start = _estimate(dataset, T_flange_camera, options, report, workers)
    finally:
        workers.close()
    chain = joint.chain
    covariance = joint.covariance[:6, :6]
    status, reason, left_open = judge(chain, covariance, start, joint.beliefs, joint.converged)
    missed = chain.missed + (chain.joints @ chain.zeros).reshape(-1, 6)
    return HandEye(
        status=status,
        reason=reason,
        T_flange_camera=chain.T_flange_camera,
        T_flange_camera_start=T_flange_camera,
        covariance=covariance,
        open=left_open,
        turned=turned(chain.T_base_flange)[0],
        missed=missed,
        residuals=joint.residuals,
        zeros=chain.zeros,
        beliefs=joint.beliefs,
        inflation=joint.inflation,
        sigma=joint.sigma,
        spacing=spacing,
        iterations=count,
        seconds=time.perf_counter() - begin,
    )


def _estimate(
    dataset: Dataset,
    T_flange_camera: Array,
    options: Options,
    report: Callable[[Iteration], None],
    workers: Workers,
) -> tuple[Joint, float, Start]:
    """Go through the levels, then let everything that errs join in; return the finest spacing."""
    sigma = np.repeat([options.start_error[0], np.radians(options.start_error[1])], 3)
    map_options = MapOptions(resolution=options.resolution, threads=options.threads)
    preset = schedule.PRESETS["default"]
    problem, chain = set_up(dataset, T_flange_camera, sigma)
    start = Start(T_flange_camera, sigma)
    levels = schedule.spacings(map_options, problem, sigma[:3], sigma[3:])
    heights, previous = None, None
    for index, spacing in enumerate(levels):
        last = index == len(levels) - 1
        level = make_level(problem, chain.T_map_camera, spacing, preset, map_options, last)
        heights = level_heights(level, heights, previous)
        for robust in (WIDE, preset.robust) if index == 0 else (preset.robust,):
            descent = descend(level, chain, heights, start, robust, LIMIT, workers, report)
            chain, heights = descent.chain, descent.heights
        previous = level.grid
    steady = without_bends(level.problem, level.grid, descent.heights, chain.T_map_camera, SHARP)
    level = replace(level, problem=steady)
    waves = waves_of(level.problem)
    noise = options.robot_noise
    stated = Beliefs(sigma, ZERO, noise[0], float(np.radians(noise[1])), PATTERN)
    return solve(level, descent, waves, start, stated, workers, report), levels[-1], start
