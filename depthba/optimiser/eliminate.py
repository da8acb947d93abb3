"""Eliminating the map: from the joint normal equations to the poses alone, and back.

The reduced matrix is ``S = A - B C^-1 B^T`` over the free frames. Two roads lead to a step:

- *direct*: :func:`depthba.optimiser.reduced.reduce` solves with C for every column of B, each over
  the window that it reaches, and S is formed and factored. On small maps that costs less than the
  pass.
- *iterative*: conjugate gradients on the exact S, each product of which is one solve with C,
  preconditioned by an S from earlier in the level, or by the *lumped* bound, which replaces C by
  the diagonal of its absolute row sums.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from depthba.optimiser import dense
from depthba.optimiser.asking import look
from depthba.optimiser.coupling import gather, spread, spread_over
from depthba.optimiser.linearise import Linearisation
from depthba.optimiser.map_solver import MapSolver
from depthba.optimiser.reduced import Reduction, lumped
from depthba.optimiser.workers import Workers

# Largest tolerance of a solve with the map's block: a looser one ends an iteration sooner or later
# by how the last digits round, which moves poses of rough scenes by 1e-6 and costs as much.
ALIKE = 1e-4


@dataclass(frozen=True)
class Step:
    """A step of poses and map."""

    pose: NDArray[np.float64]
    """(N, 6), translation then rotation about the pivots; 0 for frames that are not free."""
    map: NDArray[np.float64]
    """(ny, nx)."""
    decrement: float
    """``pose^T S pose`` with the undamped reduced matrix: the step's length in its own uncertainty,
    squared, times the residual variance."""


@dataclass(frozen=True)
class Held:
    """What the points say where part of it is noise in the map's slope.

    A gradient g that is ``-S0 x`` but for noise of covariance S says ``S0 S^-1 S0`` about x,
    through ``S0 S^-1 g``: where noise is all there is, the measured poses stand.
    """

    through: NDArray[np.float64]
    """(d, d), ``S0 S^-1`` over the free frames."""
    bound: NDArray[np.float64]
    """(d, d), ``S0 S^-1 S0``."""

    @staticmethod
    def of(S: NDArray[np.float64], sure: NDArray[np.float64], free: NDArray[np.bool_]) -> Held:
        """Return it for S (6N, 6N) and what of it is no noise, S0 (6N, 6N); free (N,) frames."""
        window = np.ix_(np.repeat(free, 6), np.repeat(free, 6))
        own = np.diag(S[window])
        ridge = 1e-9 * np.diag(own + np.max(own, initial=1e-300) * 1e-3)
        whole = S[window] + ridge
        look()
        known = sure[window]
        through = np.ascontiguousarray(dense.solved(whole, known).T)
        look()
        bound = dense.product(through, known)
        return Held(through, (bound + bound.T) / 2)


def solve(
    lin: Linearisation,
    free: NDArray[np.bool_],
    prior: tuple[NDArray[np.float64], NDArray[np.float64]],
    damping: float,
    workers: Workers,
    tolerance: float,
    outer: int,
    near: NDArray[np.float64] | None = None,
    here: Reduction | None = None,
    held: Held | None = None,
) -> Step:
    """Solve the damped normal equations.

    The map goes out of them, the poses are solved for, the map answers.

    Args:
        lin: the normal equations.
        free: (N,) frames that move.
        prior: (6N, 6N) and (N, 6), matrix and gradient that the measured poses add.
        damping: Levenberg-Marquardt, relative to the diagonal of the reduced matrix.
        workers: the threads.
        tolerance: relative residual of the reduced system at which the iterative road ends.
        outer: most products with the exact reduced matrix; 0 leaves the preconditioner's step.
        near: (6N, 6N) reduced matrix from earlier in the level: the preconditioner, in place of the
            lumped one.
        here: the reduction of ``lin`` itself: the direct road.
        held: what of an earlier reduced matrix is not noise in the map's slope, in place of all.
    """
    n = len(lin.B)
    inner = min(0.1 * tolerance, ALIKE)
    solver = MapSolver(lin.C, inner, workers)
    answer, _ = solver.solve(-lin.g_map, inner)
    g = lin.g_pose + gather(lin, answer, workers)
    keep = np.repeat(free, 6)
    if held is not None:
        steps, length = _held_step(g.ravel()[keep], prior, held, keep, damping)
        back, _ = solver.solve(spread(lin, steps, workers), inner)
        return Step(steps, answer - back, length)
    g = g + prior[1]
    S = here.S if here is not None else near if near is not None else lumped(lin, workers)
    extra = prior[0]
    bound = (S + extra)[np.ix_(keep, keep)]
    # a frame without points, or a direction nothing holds, must not make the matrix singular
    floor = 1e-12 * np.max(np.diag(bound), initial=1e-300)
    damp = damping * np.diag(bound) + floor
    factor = _factor(bound + np.diag(damp), floor)
    beside = extra[np.ix_(keep, keep)]
    steps, back = np.zeros((n, 6)), np.zeros_like(lin.g_map)

    def whole(v: NDArray[np.float64]) -> NDArray[np.float64]:
        full = np.zeros(6 * n)
        full[keep] = v
        return full.reshape(n, 6)

    if here is not None:
        x = cho_solve(factor, -g.ravel()[keep])
        steps = whole(x)
        spread_over(here.answers, steps, back, workers)
        return Step(steps, answer - back, float(x @ bound @ x))

    def product(v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        pose = whole(v)
        through, _ = solver.solve(spread(lin, pose, workers), inner)
        out = np.einsum("nij,nj->ni", lin.A, pose) - gather(lin, through, workers)
        return np.asarray(out.ravel()[keep] + beside @ v), through

    x, Sx = _preconditioned(product, factor, damp, -g.ravel()[keep], tolerance, outer, back)
    if outer == 0:
        back, _ = solver.solve(spread(lin, whole(x), workers), inner)
    return Step(whole(x), answer - back, float(x @ Sx))


def _held_step(g, prior, held, keep, damping):
    """Return the step (N, 6) that noise in the map's slope does not drive, and its length."""
    n = len(keep) // 6
    bound = held.bound + prior[0][np.ix_(keep, keep)]
    floor = 1e-12 * np.max(np.diag(bound), initial=1e-300)
    factor = _factor(bound + np.diag(damping * np.diag(bound) + floor), floor)
    x = -cho_solve(factor, held.through @ g + prior[1].ravel()[keep])
    steps = np.zeros(6 * n)
    steps[keep] = x
    return steps.reshape(n, 6), float(x @ bound @ x)


def _factor(matrix, floor):
    """Cholesky factor of a matrix that rounding may have left a little short of definite."""
    for lift in (0.0, 1e-9, 1e-6, 1e-3):
        try:
            lifted = matrix + np.diag(lift * np.diag(matrix) + (lift > 0) * floor)
            return dense.cholesky(lifted), True
        except np.linalg.LinAlgError:
            continue
    return cho_factor(np.diag(np.abs(matrix).sum(axis=1) + floor))


def _preconditioned(product, factor, damp, b, tolerance, limit, back):
    """Conjugate gradients on ``S + diag(damp)``, preconditioned by a factor near it.

    ``product`` returns S v and the map's answer to v; the answer to the solution is added up in
    ``back``. Returns x and S x.
    """
    x, Sx = np.zeros_like(b), np.zeros_like(b)
    if limit == 0:
        x = cho_solve(factor, b)
        return x, b - damp * x
    r = b.copy()
    z = cho_solve(factor, r)
    p = z.copy()
    rz = r @ z
    goal = tolerance**2 * rz
    for _ in range(limit):
        if rz <= goal or rz <= 0:
            break
        Sp, through = product(p)
        q = Sp + damp * p
        curvature = p @ q
        if curvature <= 0:
            break
        alpha = rz / curvature
        x += alpha * p
        Sx += alpha * Sp
        back += alpha * through
        r -= alpha * q
        z = cho_solve(factor, r)
        before, rz = rz, r @ z
        p = z + rz / before * p
    return x, Sx
