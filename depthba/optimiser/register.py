"""From a dataset to a result: levels from coarse to fine, then what is known about the outcome."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from depthba.dataset import Dataset
from depthba.optimiser import schedule
from depthba.optimiser.asking import listening
from depthba.optimiser.clock import Clock
from depthba.optimiser.conclusion import conclude
from depthba.optimiser.ending import gone_on
from depthba.optimiser.engine import Engine
from depthba.optimiser.grid import make_grid
from depthba.optimiser.overlap import held_frames, overlap_matrix
from depthba.optimiser.prior import pose_prior
from depthba.optimiser.problem import prepare
from depthba.optimiser.solvable import solvable
from depthba.optimiser.start import hand_eye_sigmas, pose_sigmas, reach_of_poses, start_poses
from depthba.optimiser.workers import Workers
from depthba.options import Options
from depthba.result import Iteration, Result
from depthba.selecting import selected


def register(
    dataset: Dataset | str | Path,
    options: Options | None = None,
    callback: Callable[[Iteration], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Result:
    """Register all frames of a dataset together.

    Args:
        dataset: an open dataset, or the path of one.
        options: how; the defaults where None.
        callback: called after every iteration.
        cancel: asked many times a second, also while a step is worked out; when it answers True,
            the registration ends with `Cancelled`. ``threading.Event().is_set`` does.

    Returns:
        Poses, map, covariance and history. ``result.trusted`` says whether to rely on it.

    Raises:
        DatasetError: the dataset is damaged, or has fewer than two frames with points.
        OptionError: an option makes no sense.
        Unsolvable: lengths are such that the equations cannot be solved.
        Cancelled: ``cancel`` said so.
    """
    options = options or Options()
    schedule.check(options)
    if not isinstance(dataset, Dataset):
        dataset = Dataset.open(dataset)
    dataset = selected(dataset, options)
    clock = Clock(options.time_limit)
    workers = Workers(options.threads or os.cpu_count() or 1, cancel)
    try:
        # linear algebra on one thread: how many there are would change the last digits
        with listening(cancel), threadpool_limits(1, "blas"):
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
    start = start_poses(dataset, options)
    problem = prepare(dataset, start, options.roi)
    if options.most_points is not None:
        problem = problem.at_most(options.most_points)
    clock.lap("read")
    sigma_t, sigma_r = pose_sigmas(dataset.pose_noise, options)
    reach = reach_of_poses(dataset.pose_noise, options)
    levels = schedule.spacings(options, problem, *reach)
    make_grid(problem, levels[-1], 2 * levels[-1])  # too fine a map is refused before any work
    overlap = overlap_matrix(problem, problem.T_map_camera, levels[-1])
    held = held_frames(problem, overlap)
    free = np.array([not reason for reason in held])
    measured: NDArray[np.float64] = problem.T_map_world @ dataset.T_world_camera_measured
    prior = pose_prior(
        measured,
        problem.T_map_world[:3, :3],
        sigma_t,
        sigma_r,
        np.arange(len(free)) == 0,
        hand_eye_sigmas(dataset.pose_noise, options),
    )
    clock.lap("prepare")
    engine = Engine(problem, options, prior, free, workers, clock, callback)
    stated = dataset.pose_noise is not None or None not in (options.prior_t, options.prior_r)
    ids, stamps = tuple(f.id for f in dataset), tuple(f.stamp for f in dataset)
    with solvable(problem, str(dataset.path)):
        end, known = gone_on(engine, engine.run(levels, problem.T_map_camera))
        return conclude(engine, end, known, ids, stamps, start, held, overlap, stated)
