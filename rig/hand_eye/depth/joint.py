"""Everything at once: X, the joints' zeros, the flanges, the camera's pattern and the map.

The normal equations of the poses, map eliminated, hold for all of these by the chain rule. They
are found once; each step then takes one pass over the points for the exact gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import certainty, coupling, reduced
from depthba.optimiser.level import Level
from depthba.optimiser.linearise import Linearisation, Loss, State, linearise, robust_sigma
from depthba.optimiser.noise import noise_sigma
from depthba.optimiser.problem import BLOCKS
from depthba.optimiser.slope_noise import without_slope_noise
from depthba.optimiser.workers import Workers
from rig.hand_eye.depth.believed import Beliefs, estimate, newton_step
from rig.hand_eye.depth.chain import Chain, without_gauge
from rig.hand_eye.depth.descent import Descent, Iteration, Start
from rig.hand_eye.depth.pattern import Answers, Waves, answers

Array = NDArray[np.float64]

# Rounds of strength and steps: the first strengths are found where the flanges are still as
# reported.
ROUNDS = 2
STEPS = 25
# Settled when the proposed step of X is below this many of its standard deviations (root mean
# square), and by how much a step may raise the cost.
SETTLED = 0.1
SLACK = 1e-3


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
    residuals: Array
    """(N,) the same of each frame, m."""
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
        worth = _weigh(here, state, loss, lin, stated, workers)
        reply = answers(here, state, loss, lin, waves, workers)
        J = chain.jacobian(lin.pivots)
        seen = without_gauge(J, lin.pivots)
        newton, H = _information(seen, worth, reply)
        _, gradient = _gradient(lin, seen, worth, reply, waves)
        now = _unknowns(chain, start, pattern)
        beliefs, _, covariance = estimate(H, gradient, now, stated, zeros, n, m)
        variance = beliefs.variances(zeros, n, m)

        def total(lin: Linearisation, now: Array, worth: Worth, variance: Array) -> float:
            return lin.cost + worth.temperature * float((now**2 / variance).sum())

        length, converged = 1.0, False
        for _ in range(STEPS):
            answer, gradient = _gradient(lin, seen, worth, reply, waves)
            now = _unknowns(chain, start, pattern)
            full = newton_step(newton, gradient, now, variance)
            converged = float(full[:6] @ np.linalg.solve(covariance[:6, :6], full[:6])) < (
                6 * SETTLED**2
            )
            step = length * full
            moved, bent = chain.moved(step[: len(step) - m]), pattern + step[len(step) - m :]
            poses = (J @ step[: len(step) - m]).reshape(-1, 6)
            back, _ = lin.C.solve(coupling.spread(lin, poses), 1e-4)
            raised = heights + answer - back
            if m:
                raised -= np.tensordot(step[len(step) - m :], reply.back, 1)
            after = at(moved, raised, bent)
            before_cost = total(lin, now, worth, variance)
            after_cost = total(after, _unknowns(moved, start, bent), worth, variance)
            # what the map's noise is not believed does not show in the cost: it may rise a little
            accepted = after_cost <= before_cost * (1 + SLACK)
            if accepted:
                chain, heights, pattern, lin = moved, raised, bent, after
                length = min(1.0, 2 * length)
            else:
                length /= 4
            sigma = robust_sigma(lin.residuals)
            report(Iteration(level.grid.spacing, before_cost, step[:6], accepted, sigma))
            if (accepted and converged) or length < 1e-3:
                break
    sigma = robust_sigma(lin.residuals)
    each = np.array([robust_sigma((r,)) for r in lin.residuals])
    return Joint(
        chain, heights, pattern, beliefs, covariance, worth.inflation, sigma, each, converged
    )  # fmt: skip


@dataclass(frozen=True)
class Worth:
    """What the depths are worth."""

    temperature: float
    """m^2, what a squared normalised belief costs."""
    inflation: float
    """Factor in it by which neighbours err alike."""
    S: Array
    """(6N, 6N) reduced matrix of the poses, less what noise in the map's slope put into it."""
    believed: Array
    """(6N, 6N) that takes a reduced gradient to what is left of it without that noise."""


def _unknowns(chain: Chain, start: Start, pattern: Array) -> Array:
    return np.concatenate([start.error(chain), chain.zeros, chain.missed.ravel(), pattern])


def _information(J: Array, worth: Worth, reply: Answers) -> tuple[Array, Array]:
    """Return the derivative of the gradient by all unknowns, and their information."""
    own = J.T @ worth.S @ J
    cross = J.T @ worth.believed @ reply.cross
    back = reply.cross.T @ J
    newton = np.block([[own, cross], [back, reply.own]]) / worth.temperature
    return newton, np.block([[own, cross], [cross.T, reply.own]]) / worth.temperature


def _gradient(
    lin: Linearisation, J: Array, worth: Worth, reply: Answers, waves: Waves
) -> tuple[Array, Array]:
    """Return the map's step for fixed unknowns (ny, nx), and the gradient with it (k,)."""
    answer, _ = lin.C.solve(-lin.g_map, 1e-4)
    pose = (lin.g_pose + coupling.gather(lin, answer)).ravel()
    gradient = np.concatenate([J.T @ (worth.believed @ pose), reply.gradient(waves, lin)])
    return answer, gradient / worth.temperature


def robust_excess(lin: Linearisation, loss: Loss, sigma: float) -> float:
    """Return by how much the robust loss raises the variance that the normal equations state.

    They hold the weights w where the score's variance calls for ``w^2 r^2`` and its slope for the
    derivative of ``w r`` (Huber 1964), which for Geman-McClure is ``w (1 - 3 u) / (1 + u)`` with
    ``u = r^2 / c^2``.
    """
    if loss.robust_c == 0.0 or sigma == 0.0:
        return 1.0
    w = np.concatenate(lin.weights).astype(np.float64)
    square = np.nan_to_num(np.concatenate(lin.residuals)).astype(np.float64) ** 2
    u = square / loss.robust_c**2
    inside = u < 1.0  # strays are no part of what is uncertain about the rest
    w, square, u = w[inside & (w > 0)], square[inside & (w > 0)], u[inside & (w > 0)]
    slope = float(np.mean(w * (1 - 3 * u) / (1 + u)))
    if slope <= 0.0:
        return 1.0
    return max(1.0, float(np.mean(w**2 * square)) / sigma**2 * float(np.mean(w)) / slope**2)


def _weigh(
    level: Level, state: State, loss: Loss, lin: Linearisation, stated: Beliefs, workers: Workers
) -> Worth:
    """Find out what the depths are worth.

    Blocks of the image are dealt out to groups, each frame's in another way, and the scatter of the
    groups' gradients compared with that of as many groups of single points: so far as neighbours in
    one frame err alike, the former is larger. What all frames have in common is the pattern's.
    """
    reduction = reduced.reduce(lin, workers)
    S = reduction.S
    n = len(level.problem.frames)
    rng = np.random.default_rng(0)
    count = BLOCKS[0] * BLOCKS[1]
    groups = [
        np.stack(
            [
                rng.permutation(count).astype(np.uint8)[f.blocks],
                rng.integers(0, count, len(f)).astype(np.uint8),
            ]
        )
        for f in level.problem.frames
    ]
    sigma = noise_sigma(level.problem, level.grid, state, loss, lin)
    variance = sigma**2 * robust_excess(lin, loss, sigma)
    everywhere = np.ones(n, bool)
    scores = certainty.block_scores(
        level.problem, level.grid, state, loss, lin, groups, workers, reduction
    )
    scores = scores - scores.mean(axis=1, keepdims=True)
    # in units of what the robot is thought to do: the directions count that matter beside it
    P = np.tile(1 / np.repeat([stated.robot_t, stated.robot_r], 3) ** 2, n)
    factor = 1.0
    for _ in range(10):
        V = np.linalg.inv(S + max(factor * variance, 1e-30) * np.diag(P))
        spread = [float(np.sum((s @ V) ** 2 * P)) for s in scores]
        factor = max(1.0, spread[0] / max(spread[1], 1e-300))
    temperature = max(factor * variance, 1e-30)
    held = temperature * np.diag(P)
    less, _ = without_slope_noise(
        level.problem, level.grid, state, loss, lin, S, held, everywhere, workers, sigma
    )
    # in a direction that nothing holds there is nothing to believe either
    firm = S + np.diag(1e-9 * np.diag(S) + 1e-300)
    believed: Array = np.eye(len(S))
    if less is not S:
        believed = np.asarray(np.linalg.solve(firm, less).T, np.float64)
    return Worth(temperature, factor, less, believed)
