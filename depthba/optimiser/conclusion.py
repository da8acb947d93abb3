"""The end of a registration: is it better than the start, how certain is it, what came of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.optimiser import certainty
from depthba.optimiser.ending import Known, known_at
from depthba.optimiser.engine import End, Engine
from depthba.optimiser.grid import average, filled
from depthba.optimiser.linearise import State, linearise, robust_sigma
from depthba.optimiser.noise import noise_sigma
from depthba.optimiser.reporting import astray, depth_map, frame_reports, misfits, verdict
from depthba.optimiser.slope_noise import without_slope_noise
from depthba.optimiser.solver import solve_map
from depthba.result import Result

# Rounds in which the start poses get the map that suits them best, and how exactly.
ROUNDS, TOLERANCE = 3, 1e-3


def conclude(
    engine: Engine,
    end: End,
    known: Known | None,
    ids: tuple[int, ...],
    stamps: tuple[float, ...],
    start: NDArray[np.float64],
    held: list[str],
    overlap: NDArray[np.float64],
    stated: bool,
) -> Result:
    """Compare with the start, say how certain the outcome is, and put the result together.

    Args:
        engine: that ran the levels.
        end: where they ended.
        known: what is known there, if that was found out.
        ids: of the frames.
        stamps: of the frames, s.
        start: (N, 4, 4) T_world_camera.
        held: per frame, why it did not move; empty where it did.
        overlap: (N, N).
        stated: whether the measured poses' deviations were stated, and not only supposed.
    """
    problem, level, outcome, workers = engine.problem, end.level, end.outcome, engine.workers
    prior, T_camera_start = engine.prior, engine.problem.T_map_camera
    averages = average(problem, T_camera_start, level.grid)
    began, began_lin = solve_map(
        level.problem, level.grid, State(T_camera_start, filled(averages.heights)),
        outcome.loss, level.smooth, workers, ROUNDS, TOLERANCE,
    )  # fmt: skip
    began_lin, acting = began_lin.uncoupled(), engine.acting
    cost_start = began_lin.cost + end.temperature * acting.at(T_camera_start).cost
    cost_end = linearise(
        level.problem, level.grid, outcome.state, outcome.loss, workers, level.smooth
    ).cost
    cost_end += end.temperature * acting.at(outcome.state.T_map_camera).cost
    if outcome.tied is not None:
        cost_start += outcome.tied.patches.fitted(T_camera_start, workers).cost
        cost_end += outcome.tied.cost
    # where no frame moves, the poses are the start's, whatever rounding makes of the two costs
    better = cost_end <= cost_start or not engine.free.any()
    state, lin = (outcome.state, outcome.lin) if better else (began, began_lin)
    engine.clock.lap("compare with the start")
    found = known if better else None
    found = found or known_at(engine, level, state, outcome.loss)
    firm, firm_lin, correlation = found.problem, found.lin, found.correlation
    sigma = noise_sigma(firm, level.grid, state, outcome.loss, firm_lin)
    # where no point may vouch for the map, all must; and none is better than its last digit
    sigma = max(sigma or robust_sigma(lin.residuals), problem.rounding)
    variance, inflation = correlation.inflation * sigma**2, found.inflation
    prior_there = prior.at(state.T_map_camera)
    held_by_prior = prior_there.normal_equations(firm_lin.pivots)[0]
    S, _ = without_slope_noise(
        firm, level.grid, state, outcome.loss, firm_lin, correlation.S, variance * held_by_prior,
        engine.free, workers, sigma,
    )  # fmt: skip
    judged = certainty.assess(
        level.problem, state, firm_lin, S, inflation * sigma**2, prior, engine.preset.prior,
        engine.free, ids, correlation, engine.doubt,
    )  # fmt: skip
    engine.clock.lap("certainty")
    frames = frame_reports(ids, problem, state, lin, held, overlap)
    gone = astray(ids, prior_there.distances, engine.preset.prior, stated)
    gone += misfits(frames) if better and engine.preset.robust else []
    status, reason = verdict(outcome, better, judged, frames, gone, engine.clock)
    T_world_map = se3.inverse(problem.T_map_world)
    return Result(
        status=status,
        reason=reason,
        frame_ids=ids,
        stamps=stamps,
        T_world_camera=T_world_map @ state.T_map_camera if better else start,
        T_world_camera_start=start,
        depth_map=depth_map(problem, level, state, lin, sigma),
        depth_map_start=depth_map(problem, level, began, began_lin, sigma),
        covariance=judged.covariance,
        sigma=sigma,
        inflation=inflation,
        history=tuple(engine.history),
        weak=judged.weak,
        frames=frames,
        seconds={**engine.clock.stages, "total": engine.clock.elapsed},
        overlap=overlap,
        fixed_pattern=engine.fixed_pattern,
        refused_pattern=engine.refused_pattern,
    )
