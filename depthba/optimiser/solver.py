"""Levenberg-Marquardt over poses and map on one grid.

A step is judged on the whole cost, smoothing and priors included, at the robust scale where it was
linearised and over all points: one that is not on the map pays for it, so nothing looks better by
losing points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import eliminate, reduced
from depthba.optimiser.asking import look
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import Linearisation, Loss, State, linearise, robust_sigma
from depthba.optimiser.map_solver import MapSolver
from depthba.optimiser.mixing import Mixer
from depthba.optimiser.patches import Fit
from depthba.optimiser.prior import PosePrior, PriorAt, move
from depthba.optimiser.problem import Problem
from depthba.optimiser.workers import Workers

# Factor by which steps are taken to shrink before two of them say more.
PACE = 0.5
# Times that the map is solved anew at the poses of a step before it is turned down.
FOLLOW = 2
# Tolerance of those solves.
ROUGHLY = 1e-2
# Shares of a step that are tried before it is turned down.
SHORTER = (0.5, 0.2)
# Steps whose gain may be spent on one that raises the cost, and by what factor at most.
MEMORY, LEAP = 3, 1.01


@dataclass(frozen=True)
class Rules:
    """How a level is solved."""

    robust: float
    """Scale of the Geman-McClure loss in robust standard deviations of the residuals; 0: no robust
    loss."""
    limit: int
    """Most iterations."""
    settled: float = 0.1
    """Converged when what is left to go is below this many standard deviations of the poses (root
    mean square)."""
    steady: bool = False
    """Whether the robust loss stays as wide as the start has it: it would chase the residuals that
    it lets go of."""
    gain: float = 0.0
    """Enough when a step lowers the cost by less than this share: a coarse level only has to bring
    the next into reach."""
    least: float = 0.0
    """Enough when a step lowers the cost by less than this, m^2."""
    believed: float = 1.0
    """Factor of the poses' variance over what independent residuals would leave: it scales the
    standard deviations above."""
    tolerance: float = 3e-2
    """Relative residual of the reduced system at which an iterative step is good enough."""
    outer: int = 12
    """Most products with the exact reduced matrix in one step."""


@dataclass(frozen=True)
class Progress:
    """What one iteration did."""

    state: State
    lin: Linearisation
    cost: float
    step: eliminate.Step
    damping: float
    accepted: bool
    sigma: float


@dataclass(frozen=True)
class Outcome:
    """Where a level ended."""

    state: State
    lin: Linearisation
    loss: Loss
    converged: bool
    sigma: float
    tied: Fit | None = None
    """The patches at its poses."""


def solve_map(
    problem: Problem,
    grid: Grid,
    state: State,
    loss: Loss,
    smooth: NDArray[np.bool_],
    workers: Workers,
    rounds: int = 2,
    tolerance: float = 1e-4,
) -> tuple[State, Linearisation]:
    """Solve the heights for given poses; return the state and the linearisation there."""
    lin = linearise(problem, grid, state, loss, workers, smooth)
    for _ in range(rounds):
        answer, _ = MapSolver(lin.C, tolerance, workers).solve(-lin.g_map, tolerance)
        state = replace(state, heights=state.heights + answer)
        lin = linearise(problem, grid, state, loss, workers, smooth, spare=lin)
    return state, lin


def solve_level(
    problem: Problem,
    grid: Grid,
    state: State,
    lin: Linearisation,
    loss: Loss,
    rules: Rules,
    prior: PosePrior,
    temperature: float,
    free: NDArray[np.bool_],
    smooth: NDArray[np.bool_],
    workers: Workers,
    report: Callable[[Progress], None],
    near: NDArray[np.float64] | None = None,
    sure: NDArray[np.float64] | None = None,
    over: Callable[[], bool] = lambda: False,
    tied: Fit | None = None,
) -> Outcome:
    """Iterate to convergence on one grid with one loss.

    Args:
        problem: the points.
        grid: where the nodes stand.
        state: where to start.
        lin: the linearisation there, at whatever robust scale; its arrays are overwritten.
        loss: the residual; its robust scale is set here as the residuals fall.
        rules: how to iterate.
        prior: the measured poses.
        temperature: m^2, what a squared normalised prior error costs: the residuals' variance,
            times the factor by which their correlation over the image exaggerates what they know.
        free: (N,) frames that move.
        smooth: (ny, nx) nodes under the smoothing term.
        workers: the threads.
        report: called after each iteration.
        near: (6N, 6N) the reduced matrix about where the level starts, if known.
        sure: (6N, 6N) what of it is not noise in the map's slope; None: all of it.
        over: asked before each iteration but the first whether to end.
        tied: patches that tie the frames beside the map, fitted where the level starts.
    """

    def beside(T_map_camera: NDArray[np.float64]) -> tuple[float, PriorAt, Fit | None]:
        """Return what poses cost beside the map, m^2, and what the prior and patches say there."""
        fit = None if tied is None else tied.patches.fitted(T_map_camera, workers)
        at = prior.at(T_map_camera)
        return temperature * at.cost + (fit.cost if fit else 0.0), at, fit

    sigma = robust_sigma(lin.residuals)
    loss = judge = _rescaled(loss, rules, sigma)
    lin = linearise(problem, grid, state, loss, workers, smooth, spare=lin)
    spare = None
    damping, converged = 0.0, False
    dof = 6 * max(int(free.sum()), 1)
    # a direction that goes back to its measured pose gives up what it had gained from noise
    held = None if sure is None or near is None else eliminate.Held.of(near, sure, free)
    unlearnt = 0.0 if sure is None else dof * max(temperature, sigma**2)
    mixer, pace, previous = Mixer(), PACE, np.inf
    recent: list[float] = []
    held_at = prior.at(state.T_map_camera)
    gained = 1.0
    for count in range(rules.limit):
        if count and over():
            break
        matrix, gradient = held_at.normal_equations(lin.pivots)
        believed = temperature * matrix, temperature * gradient
        told = None
        if tied is not None:
            told, pull = tied.patches.normal_equations(state.T_map_camera, lin.pivots, workers)
            believed = believed[0] + told, believed[1] + pull
        look()
        direct = sure is None and reduced.direct_is_shorter(lin)
        here = reduced.reduce(lin, workers, free=free) if direct else None
        step = eliminate.solve(
            lin, free, believed, damping, workers, rules.tolerance, rules.outer, near, here, held
        )
        length = float(np.sqrt(max(step.decrement, 0.0)))
        metric = here.S if here is not None else near
        if metric is not None and told is not None:
            metric = metric + told
        mixed = step if metric is None or damping > 0 else mixer.mix(step, metric)
        candidate = State(
            move(state.T_map_camera, lin.pivots, mixed.pose), state.heights + mixed.map
        )
        after = linearise(problem, grid, candidate, loss, workers, smooth, judge, spare)
        before_cost = lin.cost + temperature * held_at.cost
        before_cost += tied.cost if tied else 0.0
        # steps that shrink by the same factor leave a geometric series to go
        left = length * pace / (1 - pace)
        deviation = np.sqrt(dof * max(rules.believed * sigma**2, 1e-30))
        small = left < rules.settled * deviation
        # with the nodal gradient the cost may rise in the last digits while the poses still settle
        most = before_cost * (1 + (1e-3 if small else 1e-6)) + unlearnt
        aside, at, fit = beside(candidate.T_map_camera)
        after_cost = after.judged + aside
        for _ in range(FOLLOW):
            if after_cost <= most:
                break
            # where frames and map shift together, heights at edges do not follow in proportion
            candidate, after = _map_followed(
                problem, grid, candidate, after, loss, smooth, workers, judge
            )
            after_cost = after.judged + aside
        for share in SHORTER if rules.robust else ():
            if after_cost <= most:
                break
            # damping shortens the poses' part alone; what the map does may be what goes too far
            heights = state.heights + share * mixed.map
            candidate = State(move(state.T_map_camera, lin.pivots, share * mixed.pose), heights)
            after = linearise(problem, grid, candidate, loss, workers, smooth, judge, after)
            aside, at, fit = beside(candidate.T_map_camera)
            after_cost = after.judged + aside
        # points that change cells or fall off edges make the cost rough on a small scale: what the
        # last steps gained may be spent on getting over that (Grippo, Lampariello & Lucidi 1986)
        leap = min(gained, LEAP) if rules.robust else 0.0
        accepted = after_cost <= max(most, before_cost * leap)
        if accepted:
            recent = [*recent, after_cost / before_cost][-MEMORY:]
            gained = 1 / float(np.prod(recent))
            pace = min(max(0.5 * (pace + length / previous), 0.1), 0.9)
            previous = length
            mixer.took(mixed)
            state, lin, spare, judge = candidate, after, lin, loss
            sigma = robust_sigma(lin.residuals)
            if not (rules.steady and rules.robust):
                loss = _rescaled(
                    loss, rules, min(sigma, loss.robust_c / rules.robust) if rules.robust else sigma
                )
            damping = damping / 10 if damping > 1e-3 else 0.0
            held_at, tied = at, fit
        else:
            spare = after
            if mixed is step:
                damping = max(10 * damping, 1e-2)
            mixer.forget()
        report(Progress(state, lin, before_cost, step, damping, accepted, sigma))
        enough = before_cost - after_cost < max(rules.gain * before_cost, rules.least)
        if accepted and (small or enough):
            converged = True
            break
        if damping > 1e6:
            break
    return Outcome(state, lin, loss, converged, sigma, tied)


def _map_followed(
    problem: Problem,
    grid: Grid,
    state: State,
    lin: Linearisation,
    loss: Loss,
    smooth: NDArray[np.bool_],
    workers: Workers,
    judge: Loss,
) -> tuple[State, Linearisation]:
    """Take a step of the heights alone; the arrays of ``lin`` are overwritten."""
    answer, _ = MapSolver(lin.C, ROUGHLY, workers).solve(-lin.g_map, ROUGHLY)
    state = replace(state, heights=state.heights + answer)
    return state, linearise(problem, grid, state, loss, workers, smooth, judge, lin)


def _rescaled(loss: Loss, rules: Rules, sigma: float) -> Loss:
    c = rules.robust * sigma
    return replace(loss, robust_c=c, charge=c**2 if rules.robust else (3 * sigma) ** 2)
