"""From a dataset to a result: levels from coarse to fine, then what is known about the outcome."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.dataset import Dataset
from depthba.depth_map import DepthMap
from depthba.errors import OptionError
from depthba.optimiser import certainty, schedule
from depthba.optimiser.grid import Averages, Grid, average, filled, make_grid, near, resample
from depthba.optimiser.layers import down_weighted
from depthba.optimiser.linearise import Linearisation, Loss, State, Workers, linearise, robust_sigma
from depthba.optimiser.overlap import held_frames, overlap_matrix
from depthba.optimiser.prior import PosePrior, pose_prior
from depthba.optimiser.problem import Problem, prepare
from depthba.optimiser.solver import Outcome, Progress, Rules, solve_level, solve_map
from depthba.options import Options
from depthba.result import FrameReport, Iteration, Result, Status
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


@dataclass(frozen=True)
class Level:
    """One grid of the schedule, with everything that stays fixed on it."""

    problem: Problem
    grid: Grid
    averages: Averages
    smooth: NDArray[np.bool_]
    loss: Loss


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
    start = start_poses(dataset, options.init)
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
        level = make_level(problem, poses, spacing, preset, options)
        heights = level_heights(level, heights, previous)
        state, lin = solve_map(
            level.problem, level.grid, State(poses, heights), level.loss, level.smooth, workers, 1
        )
        for phase in phases(index, preset):
            last = index == len(levels) - 1 and (phase == "robust" or not preset.robust)
            rules = Rules(
                _scale(preset, phase),
                options.max_iterations,
                gain=0.0 if last else GAIN,
            )
            temperature = 0.0
            if preset.prior:
                if known is None or known.owed > NEGLIGIBLE:
                    known = certainty.correlation(
                        level.problem, level.grid, state, level.loss, lin, prior, free, workers
                    )
                temperature = known.inflation * robust_sigma(lin.residuals) ** 2

            def report(
                p: Progress, level: Level = level, index: int = index, phase: str = phase
            ) -> None:
                history.append(
                    _iteration(p, level, index, len(levels), phase, len(history), problem, clock)
                )
                callback(history[-1])

            outcome = solve_level(
                level.problem, level.grid, state, level.loss, rules, acting, temperature,
                free, level.smooth, workers, report,
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
    return min(preset.robust, WIDE) if phase == "robust" else WIDE if preset.robust else 0.0


def phases(index: int, preset: schedule.Preset) -> tuple[str, ...]:
    """Return the losses of a level.

    The robust one comes only when the poses have settled under a wide one.
    """
    if not preset.robust:
        return ("quadratic",)
    return ("quadratic", "robust") if index == 0 else ("robust",)


def start_poses(dataset: Dataset, init: str) -> NDArray[np.float64]:
    """Return (N, 4, 4) T_world_camera to start from.

    Measured, identity, or a TUM file joined by stamp.
    """
    measured = dataset.T_world_camera_measured
    if init == "measured":
        return measured
    if init == "identity":
        return np.repeat(measured[:1], len(measured), axis=0)
    if not Path(init).is_file():
        raise OptionError(f"--init {init}: expected measured, identity or a file of poses")
    stamps, poses = read_tum(init)[:2]
    found = []
    for frame in dataset:
        near = np.flatnonzero(np.abs(stamps - frame.stamp) <= 1e-6)
        if len(near) != 1:
            raise OptionError(
                f"--init {init}: {len(near)} poses for frame {frame.id} at stamp {frame.stamp:.6f}"
            )
        found.append(poses[near[0]])
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


def make_level(
    problem: Problem,
    poses: NDArray[np.float64],
    spacing: float,
    preset: schedule.Preset,
    options: Options,
) -> Level:
    """Lay the grid of a level and fix what stays fixed on it."""
    problem = problem.thinned(schedule.stride(problem, spacing))
    grid = make_grid(problem, spacing, 2 * spacing)
    averages = average(problem, poses, grid)
    if preset.robust:
        problem = down_weighted(problem, poses, spacing)
    seen = averages.count > 0
    smooth = np.ones(grid.shape, bool) if preset.whole else near(seen, 3)
    typical = float(np.median(averages.count[seen])) if seen.any() else 1.0
    return Level(
        problem,
        grid,
        averages,
        smooth,
        schedule.loss_for(preset, options, problem, spacing, typical),
    )


def level_heights(
    level: Level, heights: NDArray[np.float64] | None, previous: Grid | None
) -> NDArray[np.float64]:
    """Return the heights that a level starts from.

    Averages, and the coarser map where nothing fell.
    """
    if heights is None or previous is None:
        return filled(level.averages.heights)
    return resample(heights, previous, level.grid)


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
    sigma = robust_sigma(lin.residuals)
    known = certainty.correlation(
        level.problem, level.grid, state, outcome.loss, lin, prior, free, workers, 1e-8
    )
    factor, S = known.inflation, known.S
    judged = certainty.assess(
        level.problem, state, lin, S, factor * sigma**2, prior, preset.prior, free,
        tuple(f.id for f in dataset),
    )  # fmt: skip
    clock.lap("certainty")
    frames = _frame_reports(dataset, problem, state, lin, held, overlap)
    status, reason = verdict(outcome, better, judged, frames)
    T_world_map = se3.inverse(problem.T_map_world)
    return Result(
        status=status,
        reason=reason,
        frame_ids=tuple(f.id for f in dataset),
        stamps=tuple(f.stamp for f in dataset),
        T_world_camera=T_world_map @ state.T_map_camera if better else start,
        T_world_camera_start=start,
        depth_map=_depth_map(problem, level, state, lin, sigma),
        depth_map_start=_depth_map(problem, level, began, began_lin, sigma),
        covariance=judged.covariance,
        sigma=sigma,
        inflation=factor,
        history=tuple(history),
        weak=judged.weak,
        frames=frames,
        seconds={**clock.stages, "total": clock.elapsed},
        overlap=overlap,
    )


def verdict(
    outcome: Outcome, better: bool, judged: certainty.Certainty, frames: tuple[FrameReport, ...]
) -> tuple[Status, str]:
    """Say how the registration ended, in one word and one sentence."""
    if not better:
        return "no_better", "no poses better than the start were found; the start is returned"
    starved = [f for f in frames[1:] if f.held]
    weak = sorted({w.frame for w in judged.weak})
    if starved or weak:
        parts = [f"frame {f.frame} was held: {f.held}" for f in starved]
        if weak:
            parts.append(
                f"the data leave {len(judged.weak)} directions of {len(weak)} frames "
                "to the measured poses"
            )
        return "weak", "; ".join(parts)
    if not outcome.converged:
        return "not_converged", "the iterations ended before the poses settled"
    return "converged", "the poses settled"


def _frame_reports(
    dataset: Dataset, problem: Problem, state: State, lin: Linearisation, held: list[str],
    overlap: NDArray[np.float64],
) -> tuple[FrameReport, ...]:  # fmt: skip
    moved = se3.difference(state.T_map_camera, problem.T_map_camera)
    reports = []
    for i, frame in enumerate(dataset):
        weights = lin.weights[i]
        reports.append(
            FrameReport(
                frame=frame.id,
                points=len(problem.frames[i]),
                overlap=float(np.delete(overlap[i], i).max(initial=0.0)),
                inliers=float((weights > 0.5).mean()) if len(weights) else 0.0,
                move_t=float(np.linalg.norm(moved[i, :3])),
                move_r=float(np.linalg.norm(moved[i, 3:])),
                held=held[i],
            )
        )
    return tuple(reports)


def _depth_map(
    problem: Problem, level: Level, state: State, lin: Linearisation, sigma: float
) -> DepthMap:
    averages = average(problem, state.T_map_camera, level.grid)
    seen = near(averages.count > 0, 1) & (lin.C.own > 0)
    heights = np.where(seen, state.heights, np.nan)
    spread = np.where(seen, sigma / np.sqrt(lin.C.row_sums()), np.nan)
    return DepthMap(
        heights=heights,
        origin=(float(level.grid.origin[0]), float(level.grid.origin[1])),
        spacing=level.grid.spacing,
        T_map_world=problem.T_map_world,
        count=averages.count.astype(np.int64),
        sigma=spread,
    )


def _iteration(
    p: Progress, level: Level, index: int, levels: int, phase: str, count: int,
    problem: Problem, clock: Clock,
) -> Iteration:  # fmt: skip
    weights = np.concatenate([w[:: max(1, len(w) // 5000)] for w in p.lin.weights])
    seen = near(level.averages.count > 0, 1)
    unknown = np.full(level.grid.shape, np.nan)
    turned = np.linalg.norm(p.step.pose[:, 3:], axis=1).max()
    return Iteration(
        index=count,
        level=index,
        levels=levels,
        spacing=level.grid.spacing,
        phase="robust" if phase == "robust" else "quadratic",
        cost=p.cost,
        step_t=float(np.linalg.norm(p.step.pose[:, :3], axis=1).max()),
        step_r=float(turned),
        damping=p.damping,
        accepted=p.accepted,
        inliers=float((weights > 0.5).mean()),
        sigma=p.sigma,
        cells=int(seen.sum()),
        seconds=clock.elapsed,
        T_world_camera=se3.inverse(problem.T_map_world) @ p.state.T_map_camera,
        depth_map=DepthMap(
            heights=np.where(seen, p.state.heights, np.nan),
            origin=(float(level.grid.origin[0]), float(level.grid.origin[1])),
            spacing=level.grid.spacing,
            T_map_world=problem.T_map_world,
            count=level.averages.count.astype(np.int64),
            sigma=unknown,
        ),
    )
