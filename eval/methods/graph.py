"""Pose graphs: from relative poses of pairs to poses of all frames, by gtsam.

House order of a tangent is [translation, rotation], gtsam's is [rotation, translation]; the one
place where they meet is here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from eval.methods.gicp import ROTATION_FIRST

Floats = NDArray[np.float64]

FIXED_SIGMA = 1e-9
"""Of frame 0, m and rad: it does not move."""


@dataclass(frozen=True, eq=False)
class Edge:
    """A measured relative pose."""

    i: int
    j: int
    T_i_j: Floats
    """(4, 4), maps coordinates in frame j to coordinates in frame i."""
    information: Floats
    """(6, 6), inverse covariance of delta = [tau, phi] in T_i_j Exp(delta), axes of frame j."""


@dataclass(frozen=True, eq=False)
class Solved:
    """Poses from a graph."""

    T_world_camera: Floats
    """(N, 4, 4)."""
    weights: Floats
    """(edges,), 1 kept, 0 rejected as an outlier."""
    error: float
    """Half the weighted sum of squared residuals that are left, in standard deviations."""
    iterations: int | None
    """Of Levenberg-Marquardt; None where it runs inside something else."""
    loose: tuple[int, ...]
    """Frames that no chain of edges ties to frame 0; they keep their start pose."""


def isotropic(sigma_t: float, sigma_r: float) -> Floats:
    """Return the information (6, 6) of standard deviations, m and rad per axis."""
    return np.diag([sigma_t**-2.0] * 3 + [sigma_r**-2.0] * 3)


def solve(T_start: Floats, edges: Sequence[Edge]) -> Solved:
    """Fit poses to relative poses by Levenberg-Marquardt, frame 0 fixed.

    Args:
        T_start: (N, 4, 4), where to start.
        edges: the measurements; an edge that counts for nothing has no place here.

    """
    import gtsam

    tied, loose = _tied(len(T_start), edges)
    graph, values = _problem(T_start, edges, tied, FIXED_SIGMA)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, _accurate())
    found = optimiser.optimize()
    weights = np.array([float(e.i in tied) for e in edges])
    return Solved(
        T_world_camera=_poses(found, T_start, tied),
        weights=weights,
        error=float(graph.error(found)),
        iterations=int(optimiser.iterations()),
        loose=loose,
    )


def solve_robustly(T_start: Floats, edges: Sequence[Edge], sigma_first: float = 1e-6) -> Solved:
    """Fit poses to relative poses of which some may be wrong: graduated non-convexity, TLS loss.

    Yang, Antonante, Tzoumas and Carlone, Graduated Non-Convexity for Robust Spatial Perception
    (RA-L 2020). An edge is an outlier where its squared residual is beyond the 99 % point of
    chi-squared with six degrees of freedom.

    Args:
        T_start: (N, 4, 4), where to start.
        edges: the measurements.
        sigma_first: standard deviation of the prior on frame 0, m and rad.

    """
    import gtsam

    tied, loose = _tied(len(T_start), edges)
    graph, values = _problem(T_start, edges, tied, sigma_first)
    options = gtsam.GncLMParams(_accurate())
    options.setLossType(gtsam.GncLossType.TLS)
    options.setKnownInliers([0])
    optimiser = gtsam.GncLMOptimizer(graph, values, options)
    found = optimiser.optimize()
    weights = np.zeros(len(edges))
    kept = [k for k, e in enumerate(edges) if e.i in tied]
    judged = np.asarray(optimiser.getWeights(), dtype=np.float64)[1:]
    weights[kept] = judged
    error = sum(w * graph.at(k + 1).error(found) for k, w in enumerate(judged))
    return Solved(_poses(found, T_start, tied), weights, float(error), None, loose)


def spanning_tree(
    T_start: Floats, edges: Sequence[Edge], support: Sequence[float]
) -> tuple[Floats, list[int]]:
    """Tie frames to frame 0 by the edges of greatest support, as few as will do.

    Prim's algorithm. Returns poses (N, 4, 4), where frames that no edge reaches keep their start
    pose, and the edges used, by index.

    Args:
        T_start: (N, 4, 4).
        edges: the measurements.
        support: per edge; the greater, the more it is trusted.

    """
    T = np.array(T_start, dtype=np.float64)
    reached, used = {0}, []
    by_support = sorted(zip(support, range(len(edges)), strict=True), reverse=True)
    while True:
        for _, k in by_support:
            edge = edges[k]
            if (edge.i in reached) == (edge.j in reached):
                continue
            if edge.i in reached:
                T[edge.j] = T[edge.i] @ edge.T_i_j
            else:
                T[edge.i] = T[edge.j] @ se3.inverse(edge.T_i_j)
            reached |= {edge.i, edge.j}
            used.append(k)
            break
        else:
            return T, used


def connected(count: int, pairs: Sequence[tuple[int, int]]) -> tuple[set[int], tuple[int, ...]]:
    """Return which of ``count`` frames pairs tie to frame 0, and the others."""
    tied = {0}
    while grown := {k for i, j in pairs if (i in tied) != (j in tied) for k in (i, j)} - tied:
        tied |= grown
    return tied, tuple(k for k in range(count) if k not in tied)


def _tied(count: int, edges: Sequence[Edge]) -> tuple[set[int], tuple[int, ...]]:
    for edge in edges:
        if not (0 <= edge.i < count and 0 <= edge.j < count and edge.i != edge.j):
            raise ValueError(f"edge {edge.i} - {edge.j}: expected two of {count} frames")
    return connected(count, [(edge.i, edge.j) for edge in edges])


def _problem(T_start: Floats, edges: Sequence[Edge], tied: set[int], sigma_first: float):
    """Return gtsam's graph, the prior on frame 0 as its first factor, and start values."""
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in sorted(tied):
        values.insert(k, gtsam.Pose3(T_start[k]))
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, sigma_first)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(T_start[0]), fixed))
    for edge in edges:
        if edge.i not in tied:
            continue
        information = edge.information[np.ix_(ROTATION_FIRST, ROTATION_FIRST)]
        noise = gtsam.noiseModel.Gaussian.Information(information)
        graph.add(gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.T_i_j), noise))
    return graph, values


def _accurate():
    """Return parameters of Levenberg-Marquardt that stop late enough for micrometres."""
    import gtsam

    options = gtsam.LevenbergMarquardtParams()
    options.setRelativeErrorTol(1e-10)
    options.setAbsoluteErrorTol(1e-12)
    return options


def _poses(values, T_start: Floats, tied: set[int]) -> Floats:
    T = np.array(T_start, dtype=np.float64)
    for k in tied - {0}:
        T[k] = values.atPose3(k).matrix()
    return T
