"""From a dataset to a result: levels from coarse to fine, then what is known about the outcome."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from depthba import se3
from depthba.dataset import Dataset
from depthba.errors import OptionError
from depthba.optimiser import certainty, eliminate, schedule
from depthba.optimiser.grid import average, filled, make_grid
from depthba.optimiser.level import Level, level_heights, make_level
from depthba.optimiser.linearise import State, linearise, robust_sigma
from depthba.optimiser.overlap import held_frames, overlap_matrix
from depthba.optimiser.prior import PosePrior, pose_prior
from depthba.optimiser.problem import Problem, prepare
from depthba.optimiser.reporting import depth_map, frame_reports, iteration, verdict
from depthba.optimiser.slope_noise import without_slope_noise
from depthba.optimiser.solver import Outcome, Progress, Rules, solve_level, solve_map
from depthba.optimiser.workers import Workers
from depthba.options import Options
from depthba.result import Iteration, Result
from depthba.trajectory import read_tum

# Standard deviations of a measured pose where the dataset states none: a rig that was set up with
# some care.
USUAL_T, USUAL_R = 0.01, 0.02
# The robust loss begins this wide, in robust standard deviations: far stray points are checked, the
# rest is not.
WIDE = 12.0
# A level that only leads to the next is left when a step gains less than this share of its cost.
GAIN = 0.02
# Where the estimate owes the measured poses less than this in every direction, their exact weight
# is of no account.
NEGLIGIBLE = 0.002
# What may be left to go at the end, in standard deviations.
SETTLED = 0.03
# Tolerance of a reduced matrix that only has to be near the one it preconditions.
NEAR = 1e-2


@dataclass
class Clock:
    """Seconds per stage."""

    start: float = field(default_factory=time.perf_counter)
    last: float = field(default_factory=time.perf_counter)
    stages: dict[str, float] = field(default_factory=dict)

    def lap(self, stage: str) -> None:
        """Charge the time since the last call to a stage."""
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + now - self.last
        self.last = now

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return time.perf_counter() - self.start


def register(
    dataset: Dataset | str | Path,
    options: Options | None = None,
    callback: Callable[[Iteration], None] | None = None,
) -> Result:
    """Register all frames of a dataset together.

    Args:
        dataset: an open dataset, or the path of one.
        options: how; the defaults where None.
        callback: called after every iteration.

    Returns:
        Poses, map, covariance and history. ``result.trusted`` says whether to rely on it.

    Raises:
        DatasetError: the dataset is damaged, or has fewer than two frames with points.
        OptionError: an option makes no sense.
    """
    options = options or Options()
    schedule.check(options)
    if not isinstance(dataset, Dataset):
        dataset = Dataset.open(dataset)
    clock = Clock()
    workers = Workers(options.threads or os.cpu_count() or 1)
    try:
        return _register(dataset, options, callback or (lambda _: None), clock, workers)
    finally:
        workers.close()


def _register(
    dataset: Dataset,
    options: Options,
    callback: Callable[[Iteration], None],
    clock: Clock,
    workers: Workers,
) -> Result:
    preset = schedule.PRESETS[options.preset]
    start = start_poses(dataset, options)
    problem = prepare(dataset, start, options.roi)
    clock.lap("read")
    sigma_t, sigma_r = pose_sigmas(dataset, options)
    levels = schedule.spacings(options, problem, sigma_t, sigma_r)
    make_grid(problem, levels[-1], 2 * levels[-1])  # too fine a map is refused before any work
    overlap = overlap_matrix(problem, problem.T_map_camera, levels[-1])
    held = held_frames(problem, overlap)
    free = np.array([not reason for reason in held])
    measured = problem.T_map_world @ dataset.T_world_camera_measured
    prior = pose_prior(
        measured, problem.T_map_world[:3, :3], sigma_t, sigma_r, np.arange(len(free)) == 0
    )
    acting = prior if preset.prior else replace(prior, information=0 * prior.information)
    clock.lap("prepare")

    history: list[Iteration] = []
    known: certainty.Correlation | None = None
    poses, heights, previous = problem.T_map_camera, None, None
    for index, spacing in enumerate(levels):
        level = make_level(
            problem, poses, spacing, preset, options, last=index == len(levels) - 1
        )
        heights = level_heights(level, heights, previous)
        state, lin = solve_map(
            level.problem, level.grid, State(poses, heights), level.loss, level.smooth, workers, 1
        )
        for phase in phases(index, preset):
            last = index == len(levels) - 1 and (phase == "robust" or not preset.robust)
            rules = Rules(
                _scale(preset, phase),
                options.max_iterations,
                settled=SETTLED if last else 0.1,
                gain=0.0 if last else GAIN,
            )
            temperature = 0.0
            clock.lap(f"level {index} map")
            reduction = eliminate.reduce(lin, workers, NEAR)
            clock.lap(f"level {index} reduce")
            if preset.prior:
                if known is None or known.owed > NEGLIGIBLE:
                    known = certainty.correlation(
                        level.problem, level.grid, state, level.loss, lin, prior, free, workers,
                        reduction,
                    )  # fmt: skip
                clock.lap(f"level {index} correlation")
                temperature = known.inflation * robust_sigma(lin.residuals) ** 2

            def report(
                p: Progress, level: Level = level, index: int = index, phase: str = phase
            ) -> None:
                history.append(
                    iteration(
                        p, level, index, len(levels), phase, len(history), problem, clock.elapsed
                    )
                )
                callback(history[-1])

            outcome = solve_level(
                level.problem, level.grid, state, level.loss, rules, acting, temperature,
                free, level.smooth, workers, report, reduction.S,
            )  # fmt: skip
            state, lin = outcome.state, outcome.lin
            clock.lap(f"level {index} {phase}")
        poses, heights, previous = state.T_map_camera, state.heights, level.grid

    return _conclude(
        dataset, options, preset, problem, level, outcome, prior, temperature, free, held, overlap,
        start, history, clock, workers,
    )  # fmt: skip


def _scale(preset: schedule.Preset, phase: str) -> float:
    """Return the robust scale of a phase, in robust standard deviations.

    0 without a robust loss.
    """
    if not preset.robust:
        return 0.0
    return preset.robust if phase == "robust" else WIDE


def phases(index: int, preset: schedule.Preset) -> tuple[str, ...]:
    """Return the losses of a level.

    The robust one comes only when the poses have settled under a wide one.
    """
    if not preset.robust:
        return ("quadratic",)
    return ("quadratic", "robust") if index == 0 else ("robust",)


def start_poses(dataset: Dataset, options: Options) -> NDArray[np.float64]:
    """Return (N, 4, 4) T_world_camera to start from.

    Measured, identity, from pairs of frames, or a TUM file joined by stamp.
    """
    init, measured = options.init, dataset.T_world_camera_measured
    if init == "measured":
        return measured
    if init == "identity":
        return np.repeat(measured[:1], len(measured), axis=0)
    if init == "pairwise":
        from depthba.pairwise import dataset_poses

        sigma_t, sigma_r = pose_sigmas(dataset, options)
        return dataset_poses(dataset, sigma_t, sigma_r, options.threads).T_world_camera
    if not Path(init).is_file():
        raise OptionError(f"--init {init}: expected measured, identity, pairwise or a file")
    stamps, poses = read_tum(init)[:2]
    found = []
    for frame in dataset:
        same = np.flatnonzero(np.abs(stamps - frame.stamp) <= 1e-6)
        if len(same) != 1:
            raise OptionError(
                f"--init {init}: {len(same)} poses for frame {frame.id} at stamp {frame.stamp:.6f}"
            )
        found.append(poses[same[0]])
    return np.stack(found)


def pose_sigmas(
    dataset: Dataset, options: Options
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the standard deviations (3,) m and (3,) rad of the measured poses.

    Options, dataset, or usual ones.
    """
    noise = dataset.pose_noise
    sigma_t = np.array(noise.sigma_t_m if noise else (USUAL_T,) * 3, dtype=float)
    sigma_r = np.array(noise.sigma_r_rad if noise else (USUAL_R,) * 3, dtype=float)
    # an axis stated without error still gets a trace of it: no axis is perfect
    sigma_t, sigma_r = np.maximum(sigma_t, 1e-6), np.maximum(sigma_r, 1e-6)
    if options.prior_t is not None:
        sigma_t = np.full(3, options.prior_t)
    if options.prior_r is not None:
        sigma_r = np.full(3, options.prior_r)
    return sigma_t, sigma_r


def _conclude(
    dataset: Dataset, options: Options, preset: schedule.Preset, problem: Problem, level: Level,
    outcome: Outcome, prior: PosePrior, temperature: float, free: NDArray[np.bool_],
    held: list[str], overlap: NDArray[np.float64], start: NDArray[np.float64],
    history: list[Iteration], clock: Clock, workers: Workers,
) -> Result:  # fmt: skip
    """Compare with the start, say how certain the outcome is, and put the result together."""
    T_camera_start = problem.T_map_camera
    averages = average(problem, T_camera_start, level.grid)
    began, began_lin = solve_map(
        level.problem, level.grid, State(T_camera_start, filled(averages.heights)),
        outcome.loss, level.smooth, workers, 3,
    )  # fmt: skip
    acting = temperature if preset.prior else 0.0
    outcome_lin = linearise(
        level.problem, level.grid, outcome.state, outcome.loss, workers, level.smooth
    )
    cost_start = began_lin.cost + acting * prior.cost(T_camera_start)
    cost_end = outcome_lin.cost + acting * prior.cost(outcome.state.T_map_camera)
    better = cost_end <= cost_start
    state, lin = (outcome.state, outcome.lin) if better else (began, began_lin)
    clock.lap("compare with the start")
    sigma = certainty.noise_sigma(level.problem, level.grid, state, outcome.loss, lin)
    known = certainty.correlation(
        level.problem, level.grid, state, outcome.loss, lin, prior, free, workers
    )
    factor = known.inflation
    held_by_prior = block_diag(*prior.normal_equations(state.T_map_camera, lin.pivots)[0])
    S = without_slope_noise(
        level.problem, level.grid, state, outcome.loss, lin, known.S,
        factor * sigma**2 * held_by_prior, free, workers, sigma,
    )  # fmt: skip
    judged = certainty.assess(
        level.problem, state, lin, S, factor * sigma**2, prior, preset.prior, free,
        tuple(f.id for f in dataset),
    )  # fmt: skip
    clock.lap("certainty")
    frames = frame_reports(dataset, problem, state, lin, held, overlap)
    status, reason = verdict(outcome, better, judged, frames)
    T_world_map = se3.inverse(problem.T_map_world)
    return Result(
        status=status,
        reason=reason,
        frame_ids=tuple(f.id for f in dataset),
        stamps=tuple(f.stamp for f in dataset),
        T_world_camera=T_world_map @ state.T_map_camera if better else start,
        T_world_camera_start=start,
        depth_map=depth_map(problem, level, state, lin, sigma),
        depth_map_start=depth_map(problem, level, began, began_lin, sigma),
        covariance=judged.covariance,
        sigma=sigma,
        inflation=factor,
        history=tuple(history),
        weak=judged.weak,
        frames=frames,
        seconds={**clock.stages, "total": clock.elapsed},
        overlap=overlap,
    )
