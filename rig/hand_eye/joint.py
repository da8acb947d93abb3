"""Everything at once: X, the joints' zeros, the flanges, the camera's pattern and the map.

The normal equations of the poses, map eliminated, hold for all of these by the chain rule. They
are found once; each step then takes one pass over the points for the exact gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import certainty, eliminate
from depthba.optimiser.level import Level
from depthba.optimiser.linearise import Linearisation, Loss, State, Workers, linearise, robust_sigma
from depthba.optimiser.problem import BLOCKS
from depthba.optimiser.slope_noise import without_slope_noise
from rig.hand_eye.believed import Beliefs, estimate, posterior
from rig.hand_eye.chain import Chain
from rig.hand_eye.descent import Descent, Iteration, Start
from rig.hand_eye.pattern import Answers, Waves, answers

Array = NDArray[np.float64]

# Rounds of strength and steps: the first strengths are found where the flanges are still as
# reported.
ROUNDS = 3
STEPS = 12
# Settled when a step of X is below this many of its standard deviations (root mean square).
SETTLED = 0.03


@dataclass(frozen=True)
class Joint:
    """The estimate and how certain it is."""

    chain: Chain
    heights: Array
    pattern: Array
    """(m,), m."""
    beliefs: Beliefs
    covariance: Array
    """(k, k) of X, the joints' zeros, the flanges and the pattern."""
    inflation: float
    """Factor by which what the residuals still share with their neighbours inflates their
    variance."""
    sigma: float
    """Robust standard deviation of the residuals, m."""
    cost: float
    """Beliefs included, m^2."""
    converged: bool


def solve(
    level: Level,
    descent: Descent,
    waves: Waves,
    start: Start,
    stated: Beliefs,
    workers: Workers,
    report: Callable[[Iteration], None],
) -> Joint:
    """Refine what the descent found.

    Args:
        level: the points and the grid.
        descent: where to start.
        waves: of the pattern, at the level's points.
        start: the transform that the descent started from.
        stated: the beliefs to begin with.
        workers: the threads.
        report: called after each step.
    """
    chain, heights, loss = descent.chain, descent.heights, descent.loss
    n, zeros, m = len(chain.missed), len(chain.zeros), waves.count
    pattern, beliefs, converged = np.zeros(m), stated, False
    problem = level.problem

    def at(chain: Chain, heights: Array, pattern: Array) -> Linearisation:
        state = State(chain.T_map_camera, heights)
        points = waves.without(problem, pattern) if m else problem
        return linearise(points, level.grid, state, loss, workers, level.smooth)

    lin = at(chain, heights, pattern)
    for _ in range(ROUNDS):
        here = replace(level, problem=waves.without(problem, pattern) if m else problem)
        state = State(chain.T_map_camera, heights)
        temperature, inflation, S = _weigh(here, state, loss, lin, stated, workers)
        reply = answers(here, state, loss, lin, waves, workers)
        J = chain.jacobian(lin.pivots)
        H = _information(J, S, reply) / temperature
        _, gradient = _gradient(lin, J, reply, waves)
        now = _unknowns(chain, start, pattern)
        beliefs, _, covariance = estimate(H, gradient / temperature, now, stated, zeros, n, m)
        variance = beliefs.variances(zeros, n, m)

        def total(lin: Linearisation, chain: Chain, pattern: Array) -> float:
            believed = _unknowns(chain, start, pattern) ** 2 / variance  # noqa: B023
            return lin.cost / temperature + float(believed.sum())  # noqa: B023

        converged, length = False, 1.0
        for _ in range(STEPS):
            answer, gradient = _gradient(lin, J, reply, waves)
            now = _unknowns(chain, start, pattern)
            full, _ = posterior(H, gradient / temperature, now, variance)
            step = length * full
            moved, bent = chain.moved(step[: len(step) - m]), pattern + step[len(step) - m :]
            poses = (J @ step[: len(step) - m]).reshape(-1, 6)
            back, _ = lin.C.solve(eliminate.spread(lin, poses), 1e-4)
            raised = heights + answer - back
            if m:
                raised -= np.tensordot(step[len(step) - m :], reply.back, 1)
            after = at(moved, raised, bent)
            before_cost, after_cost = total(lin, chain, pattern), total(after, moved, bent)
            x = step[:6]
            small = float(x @ np.linalg.solve(covariance[:6, :6], x)) < 6 * SETTLED**2
            accepted = after_cost <= before_cost * (1 + (1e-3 if small else 1e-6))
            if accepted:
                chain, heights, pattern, lin = moved, raised, bent, after
                length = min(1.0, 2 * length)
            else:
                length /= 4
            sigma = robust_sigma(lin.residuals)
            report(Iteration(level.grid.spacing, before_cost * temperature, x, accepted, sigma))
            if accepted and small and length == 1.0:
                converged = True
                break
            if length < 1e-3:
                break
    cost = temperature * total(lin, chain, pattern)
    sigma = robust_sigma(lin.residuals)
    return Joint(chain, heights, pattern, beliefs, covariance, inflation, sigma, cost, converged)


def _unknowns(chain: Chain, start: Start, pattern: Array) -> Array:
    return np.concatenate([start.error(chain), chain.zeros, chain.missed.ravel(), pattern])


def _information(J: Array, S: Array, reply: Answers) -> Array:
    """Return the reduced matrix of all unknowns, map eliminated."""
    cross = J.T @ reply.cross
    return np.block([[J.T @ S @ J, cross], [cross.T, reply.own]])


def _gradient(lin: Linearisation, J: Array, reply: Answers, waves: Waves) -> tuple[Array, Array]:
    """Return the map's step for fixed unknowns (ny, nx), and the gradient with it."""
    answer, _ = lin.C.solve(-lin.g_map, 1e-5)
    pose = J.T @ (lin.g_pose + eliminate.gather(lin, answer)).ravel()
    return answer, np.concatenate([pose, reply.gradient(waves, lin)])


def _weigh(
    level: Level, state: State, loss: Loss, lin: Linearisation, stated: Beliefs, workers: Workers
) -> tuple[float, float, Array]:
    """Return what a squared normalised belief costs, m^2, the inflation in it, and S (6N, 6N).

    Blocks of the image are dealt out to groups, each frame's in another way, and the scatter of the
    groups' gradients compared with that of as many groups of single points: so far as neighbours in
    one frame err alike, the former is larger. What all frames have in common is the pattern's.
    """
    S = eliminate.exact(lin, workers, 1e-4)
    n = len(level.problem.frames)
    rng = np.random.default_rng(0)
    count = BLOCKS[0] * BLOCKS[1]
    dealt = tuple(rng.permutation(count).astype(np.uint8)[f.blocks] for f in level.problem.frames)
    single = tuple(rng.integers(0, count, len(f)).astype(np.uint8) for f in level.problem.frames)
    variance = robust_sigma(lin.residuals) ** 2
    everywhere = np.ones(n, bool)
    scores = [
        certainty.block_scores(level.problem, level.grid, state, loss, lin, groups, workers)
        for groups in (dealt, single)
    ]
    scores = [s - s.mean(axis=0) for s in scores]
    # in units of what the robot is thought to do: the directions count that matter beside it
    P = np.tile(1 / np.repeat([stated.robot_t, stated.robot_r], 3) ** 2, n)
    factor = 1.0
    for _ in range(10):
        V = np.linalg.inv(S + max(factor * variance, 1e-30) * np.diag(P))
        spread = [float(np.sum((s @ V) ** 2 * P)) for s in scores]
        factor = max(1.0, spread[0] / max(spread[1], 1e-300))
    temperature = max(factor * variance, 1e-30)
    held = temperature * np.diag(P)
    S = without_slope_noise(
        level.problem, level.grid, state, loss, lin, S, held, everywhere, workers
    )
    return temperature, factor, S
