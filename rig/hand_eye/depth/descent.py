"""Levenberg-Marquardt over the hand-eye transform and the map on one grid.

All frames share six unknowns, so a step takes seven solves with the map's block and no matrix of
all frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.optimiser import coupling
from depthba.optimiser.level import Level
from depthba.optimiser.linearise import Linearisation, Loss, State, linearise, robust_sigma
from depthba.optimiser.solver import solve_map
from depthba.optimiser.workers import Workers
from rig.hand_eye.depth.chain import Chain, without_gauge

Array = NDArray[np.float64]

# Enough when the step is below this many standard deviations (root mean square), or gains less than
# this share of the cost: a level only has to bring what follows into reach.
SETTLED = 0.1
GAIN = 0.01


@dataclass(frozen=True)
class Start:
    """The transform to start from and how far off it may be."""

    T_flange_camera: Array
    """(4, 4)."""
    sigma: Array
    """(6,) m and rad."""

    def error(self, chain: Chain) -> Array:
        """Return (6,) by which the chain's transform has left the start."""
        return se3.difference(chain.T_flange_camera, self.T_flange_camera)

    def cost(self, chain: Chain) -> float:
        """Return the squared normalised error."""
        return float(np.sum((self.error(chain) / self.sigma) ** 2))


@dataclass(frozen=True)
class Iteration:
    """What one step did."""

    spacing: float
    """Of the map, m."""
    cost: float
    """Before the step, m^2."""
    step: NDArray[np.floating[Any]]
    """(6,) of X, m and rad."""
    accepted: bool
    sigma: float
    """Robust standard deviation of the residuals, m."""


@dataclass(frozen=True)
class Descent:
    """Where a level ended."""

    chain: Chain
    heights: Array
    loss: Loss
    lin: Linearisation


def descend(
    level: Level,
    chain: Chain,
    heights: Array,
    start: Start,
    robust: float,
    limit: int,
    workers: Workers,
    report: Callable[[Iteration], None],
) -> Descent:
    """Iterate X and the map until they hardly gain.

    Args:
        level: the points and the grid.
        chain: where to start.
        heights: (ny, nx) where to start.
        start: holds what the data leave open.
        robust: scale of the Geman-McClure loss in robust standard deviations of the residuals.
        limit: most iterations.
        workers: the threads.
        report: called after each iteration.
    """

    def at(chain: Chain, heights: Array, loss: Loss, judge: Loss | None = None) -> Linearisation:
        state = State(chain.T_map_camera, heights)
        return linearise(level.problem, level.grid, state, loss, workers, level.smooth, judge)

    plain = replace(level.loss, robust_c=0.0)
    state, lin = solve_map(
        level.problem, level.grid, State(chain.T_map_camera, heights), plain, level.smooth,
        workers, 1, 1e-2,
    )  # fmt: skip
    heights = state.heights
    sigma = robust_sigma(lin.residuals)
    loss = judge = _rescaled(level.loss, robust * sigma)
    lin = at(chain, heights, loss)
    damping = 0.0
    for _ in range(limit):
        temperature = sigma**2
        answer, _ = lin.C.solve(-lin.g_map, 1e-3)
        J = chain.by_hand_eye(lin.pivots)
        held = temperature / start.sigma**2
        seen = without_gauge(J, lin.pivots)
        gradient = seen.T @ (lin.g_pose + coupling.gather(lin, answer)).ravel()
        gradient += held * start.error(chain)
        through, M = responses(lin, J, seen, workers)
        M += np.diag(held)
        x = -np.linalg.solve(M + damping * np.diag(np.diag(M)), gradient)
        map_step = answer - np.tensordot(x, through, 1)
        candidate, raised = chain.moved(x), heights + map_step
        after = at(candidate, raised, loss, judge)
        before_cost = lin.cost + temperature * start.cost(chain)
        after_cost = after.judged + temperature * start.cost(candidate)
        small = float(x @ M @ x) < SETTLED**2 * 6 * max(temperature, 1e-30)
        # with the nodal gradient the cost may rise in the last digits while X still settles
        accepted = after_cost <= before_cost * (1 + (1e-3 if small else 1e-6))
        if accepted:
            chain, heights, lin, judge = candidate, raised, after, loss
            sigma = robust_sigma(lin.residuals)
            loss = _rescaled(loss, min(robust * sigma, loss.robust_c))
            damping = damping / 10 if damping > 1e-6 else 0.0
        else:
            damping = max(10 * damping, 1e-4)
        report(Iteration(level.grid.spacing, before_cost, x, accepted, sigma))
        if accepted and (small or before_cost - after_cost < GAIN * before_cost):
            break
        if damping > 1e6:
            break
    return Descent(chain, heights, loss, lin)


def responses(lin: Linearisation, J: Array, seen: Array, workers: Workers) -> tuple[Array, Array]:
    """Return the map's answer ``C^-1 B^T J`` (k, ny, nx) and the information.

    Args:
        lin: the normal equations.
        J: (6N, k), perturbations of the cameras.
        seen: (6N, k), the same less what moves all cameras alike.
        workers: the threads.
    """
    n = len(lin.B)

    def one(column: Array) -> tuple[Array, Array]:
        pose = column.reshape(n, 6)
        field, _ = lin.C.solve(coupling.spread(lin, pose), 1e-3)
        product = np.einsum("nij,nj->ni", lin.A, pose) - coupling.gather(lin, field)
        return field, product.ravel()

    fields, products = zip(*workers.map(one, list(J.T)), strict=True)
    M = seen.T @ np.stack(products, axis=1)
    return np.stack(fields), np.asarray((M + M.T) / 2)


def _rescaled(loss: Loss, c: float) -> Loss:
    return replace(loss, robust_c=c, charge=c**2)
