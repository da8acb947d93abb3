"""Levenberg-Marquardt with the exact Hessian, section VI of the paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from eval.methods.balm2.clusters import Floats
from eval.methods.balm2.cost import cost, linearise, retract
from eval.methods.balm2.voxels import Planes


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
    options: SolverOptions = SolverOptions(),  # noqa: B008
    moves: NDArray[np.bool_] | None = None,
) -> Solution:
    """Move the frames to least cost.

    No gauge is fixed while frames move: all are expressed relative to the first one afterwards.

    Args:
        planes: frozen.
        T_world_camera: (N, 4, 4), the start.
        options: of the solver.
        moves: (N,) frames that move; None: all. The others stay, their points count. If the first
            one stays, nothing is re-expressed.

    """
    moves = np.ones(planes.frames, dtype=bool) if moves is None else moves
    free = np.repeat(moves, 6)
    T, damping, growth = T_world_camera, options.damping, options.growth
    trials: list[Trial] = []
    here = linearise(planes, T)
    now = here.cost
    for _ in range(options.iterations):
        D = np.diag(here.H)[free]
        J = here.J[free]
        try:
            x = -np.linalg.solve(here.H[np.ix_(free, free)] + np.diag(damping * D), J)
        except np.linalg.LinAlgError:
            break
        step = np.zeros(len(free))
        step[free] = x
        moved = retract(T, step.reshape(-1, 6))
        after = cost(planes, moved)
        trials.append(Trial(now, after, damping))
        change = (now - after) / now if now > 0 else 0.0
        if after < now:
            # how well the quadratic foresaw the gain says how far to trust it next
            ratio = (now - after) / (0.5 * float(x @ (damping * D * x - J)))
            damping *= max(1 / 3, 1 - (2 * ratio - 1) ** 3)
            growth = options.growth
            T, now = moved, after
            if abs(change) < options.tolerance:
                break
            here = linearise(planes, T)
        else:
            damping *= growth
            growth *= 2.0
            if abs(change) < options.tolerance:
                break
    if moves[0]:
        T = se3.align_first(T, T_world_camera)
    return Solution(T, now, tuple(trials))
