"""Levenberg-Marquardt with the exact Hessian; the damping follows how well steps were foreseen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from eval.methods.balm2.clusters import Floats, join_clusters
from eval.methods.balm2.cost import cost, linearise, retract
from eval.methods.balm2.voxels import Planes

FARTHER = 10.0
"""What a step out of reach multiplies the damping by. That bends the step away from where frames
are hardly held, which shortening it would not."""


@dataclass(frozen=True)
class SolverOptions:
    """The schedule of the damping, and when to stop."""

    damping: float = 0.01
    """At the start, times the diagonal of the Hessian."""
    growth: float = 2.0
    """What a first turned-down step multiplies the damping by; the next by twice that, and on."""
    iterations: int = 10
    """At most, turned-down steps included."""
    tolerance: float = 1e-6
    """Relative change of the cost at which to stop."""
    downhill: bool = False
    """Whether curvature counts by its magnitude, so that steps lead down where the Hessian is not
    definite, far from the optimum. The paper takes it as it is."""
    reach: float = float("inf")
    """Farthest that a frame's points may go from where their planes were found, root mean square,
    m: steps beyond are turned down. The paper has no such bound."""


@dataclass(frozen=True)
class Trial:
    """One step that was tried."""

    before: float
    """Cost, m²."""
    after: float
    """Cost, m²; the step was taken where this is less."""
    damping: float
    """That it was found with."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the frames went."""

    T_world_camera: Floats
    """(N, 4, 4), the first frame's as it was."""
    cost: float
    """m²."""
    trials: tuple[Trial, ...]


def solve(
    planes: Planes,
    T_world_camera: Floats,
    options: SolverOptions = SolverOptions(),
    moves: NDArray[np.bool_] | None = None,
) -> Solution:
    """Move the frames to least cost.

    No gauge is fixed while frames move: all are expressed relative to the first one afterwards.

    Args:
        planes: frozen.
        T_world_camera: (N, 4, 4), the start.
        options: of the solver.
        moves: (N,) frames that move; None: all. The others stay, and their points count for
            nothing. If the first one stays, nothing is re-expressed.

    """
    moves = np.ones(planes.frames, dtype=bool) if moves is None else moves
    free = np.repeat(moves, 6)
    planes = planes.only(moves)
    T, damping, growth = T_world_camera, options.damping, options.growth
    trials: list[Trial] = []
    now, J, H = _system(planes, T, free, options.downhill)
    for _ in range(options.iterations):
        D = np.diag(H)
        try:
            x = -np.linalg.solve(H + np.diag(damping * D), J)
        except np.linalg.LinAlgError:
            break
        if not np.isfinite(x).all():
            break
        step = np.zeros(len(free))
        step[free] = x
        moved = retract(T, step.reshape(-1, 6))
        after = cost(planes, moved)
        trials.append(Trial(now, after, damping))
        change = (now - after) / now if now > 0 else 0.0
        near = displacement(planes, T_world_camera, moved).max() <= options.reach
        if after < now and near:
            # how well the quadratic foresaw the gain says how far to trust it next
            ratio = (now - after) / (0.5 * float(x @ (damping * D * x - J)))
            damping *= max(1 / 3, 1 - (2 * ratio - 1) ** 3)
            growth = options.growth
            T, now = moved, after
            if abs(change) < options.tolerance:
                break
            _, J, H = _system(planes, T, free, options.downhill)
        elif not near:
            damping *= FARTHER
        else:
            damping *= growth
            growth *= 2.0
            if abs(change) < options.tolerance:
                break
    if moves[0]:
        T = np.where(moves[:, None, None], se3.align_first(T, T_world_camera), T)
    return Solution(T, now, tuple(trials))


def _system(
    planes: Planes, T_world_camera: Floats, free: NDArray[np.bool_], downhill: bool
) -> tuple[float, Floats, Floats]:
    """Return the cost, m², and its derivatives in what is free, of first and second order."""
    here = linearise(planes, T_world_camera)
    H = here.H[np.ix_(free, free)]
    if downhill:
        values, axes = np.linalg.eigh(H)
        H = (axes * np.abs(values)) @ axes.T
    return here.cost, here.J[free], H


def displacement(planes: Planes, T_a: Floats, T_b: Floats) -> Floats:
    """Return how far the points on planes are apart (N,), m, root mean square by frame.

    0 for a frame that sees no plane.

    Args:
        planes: whose points.
        T_a: (N, 4, 4), the frames' poses.
        T_b: (N, 4, 4), others.

    """
    C = join_clusters(planes.clusters, planes.frame, planes.frames)
    apart = (T_b - T_a)[:, :3]
    squares = np.einsum("nij,njk,nik->n", apart, C, apart)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0) / np.maximum(C[:, 3, 3], 1.0)))
