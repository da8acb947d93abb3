"""A robust pose graph: Gauss-Newton under graduated non-convexity.

The loss of an edge is truncated quadratic, reached through smoother ones (Yang, Antonante, Tzoumas
and Carlone, "Graduated Non-Convexity for Robust Spatial Perception", 2020). Edges that contradict
the cycles they close end with weight 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from depthba import se3

Floats = NDArray[np.float64]

# Factor by which the loss comes closer to the truncated one, round by round.
SHARPEN = 1.4
ROUNDS = 60


@dataclass(frozen=True)
class Edge:
    """What is known of two frames."""

    i: int
    j: int
    T_i_j: Floats
    """(4, 4)."""
    at: Floats
    """(3,), the middle of what both see, in the sensor frame of j, m."""
    lever: float
    """Distance from there at which a rotation is felt, m."""
    weight: float = 1.0
    """How much it counts against others."""


@dataclass(frozen=True)
class Solution:
    """Poses and how much of each edge was believed."""

    T_map_camera: Floats
    """(N, 4, 4)."""
    believed: Floats
    """(edges,), 0 to 1."""
    off: Floats
    """(edges,), m, by how much each edge disagrees."""


def solve(
    T_map_camera: Floats, edges: list[Edge], tolerance: float, start_information: Floats
) -> Solution:
    """Find the poses that agree with most edges; frame 0 stays.

    Args:
        T_map_camera: (N, 4, 4), the start.
        edges: pairs.
        tolerance: m, what an edge that is right may disagree by.
        start_information: (N, 6, 6), how surely the start is known, world axes about the camera
            centre, inverse of m^2 and rad^2; an edge's deviation is ``tolerance / 3``.
    """
    T = T_map_camera.copy()
    if not edges:
        return Solution(T, np.zeros(0), np.zeros(0))
    information = start_information * (tolerance / 3) ** 2
    believed = np.ones(len(edges))
    T = _descend(T, T_map_camera, edges, believed, information, 5)
    squared = np.square(_disagreement(T, edges))
    limit = tolerance**2
    mu = limit / max(2 * squared.max() - limit, limit)
    for _ in range(ROUNDS):
        middle = np.sqrt(limit * mu * (mu + 1) / np.maximum(squared, 1e-30)) - mu
        believed = np.where(
            squared <= limit * mu / (mu + 1),
            1.0,
            np.where(squared >= limit * (mu + 1) / mu, 0.0, middle),
        )
        T = _descend(T, T_map_camera, edges, believed, information, 2)
        squared = np.square(_disagreement(T, edges))
        if mu > 1e4:
            break
        mu *= SHARPEN
    T = _attached(T, edges, (squared < limit), tolerance)
    believed = (_disagreement(T, edges) < tolerance).astype(float)
    T = _descend(T, T_map_camera, edges, believed, information, 10)
    return Solution(T, believed, _disagreement(T, edges))


def _attached(
    T: Floats, edges: list[Edge], believed: NDArray[np.bool_], tolerance: float
) -> Floats:
    """Tie groups of frames to the first one's, where wrong edges drowned the right ones.

    Each edge between the two says where the group would lie; the place that edges of the most
    weight agree on is taken.
    """
    T = T.copy()
    i, j = (np.array([getattr(e, name) for e in edges]) for name in ("i", "j"))
    weight = np.array([e.weight for e in edges])
    while True:
        ties = sparse.coo_matrix((believed, (i, j)), (len(T), len(T)))
        group = connected_components(ties, directed=False)[1]
        best, moved, member = 0.0, T, group == group[0]
        for k in np.flatnonzero((group[i] == group[0]) != (group[j] == group[0])):
            inside, outside = (i[k], j[k]) if group[i[k]] == group[0] else (j[k], i[k])
            Z = edges[k].T_i_j if inside == i[k] else se3.inverse(edges[k].T_i_j)
            these = group == group[outside]
            candidate = T.copy()
            candidate[these] = T[inside] @ Z @ se3.inverse(T[outside]) @ T[these]
            bridges = (these[i] & member[j]) | (member[i] & these[j])
            support = float(weight[bridges & (_disagreement(candidate, edges) < tolerance)].sum())
            if support > best:
                best, moved = support, candidate
        if not best:
            return T
        T = moved
        # what ties the new group must hold, or the loop would not end
        believed = believed | (_disagreement(T, edges) < tolerance)


def _errors(T: Floats, edges: list[Edge]) -> tuple[Floats, Floats]:
    """Return the errors (edges, 6), m, and where the edges' middles lie (edges, 3)."""
    i, j = (np.array([getattr(e, name) for e in edges]) for name in ("i", "j"))
    Z = np.stack([e.T_i_j for e in edges])
    at = np.stack([e.at for e in edges])
    lever = np.array([e.lever for e in edges])[:, None]
    T_by_i = T[i] @ Z
    by_i = np.einsum("nij,nj->ni", T_by_i[:, :3, :3], at) + T_by_i[:, :3, 3]
    by_j = np.einsum("nij,nj->ni", T[j][:, :3, :3], at) + T[j][:, :3, 3]
    turn = se3.log_so3(T_by_i[:, :3, :3] @ np.swapaxes(T[j][:, :3, :3], 1, 2))
    return np.concatenate([by_i - by_j, lever * turn], axis=1), by_j


def _disagreement(T: Floats, edges: list[Edge]) -> Floats:
    return np.asarray(np.linalg.norm(_errors(T, edges)[0], axis=1))


def _descend(
    T: Floats, start: Floats, edges: list[Edge], believed: Floats, information: Floats, most: int
) -> Floats:
    """Gauss-Newton; a step perturbs each pose in map axes about its camera centre."""
    n, m = len(T), len(edges)
    i, j = (np.array([getattr(e, name) for e in edges]) for name in ("i", "j"))
    lever = np.array([e.lever for e in edges])
    weight = believed * np.array([e.weight for e in edges])
    for _ in range(most):
        error, where = _errors(T, edges)
        J_i, J_j = np.zeros((m, 6, 6)), np.zeros((m, 6, 6))
        for J, k, sign in ((J_i, i, 1.0), (J_j, j, -1.0)):
            J[:, :3, :3] = sign * np.eye(3)
            J[:, :3, 3:] = -sign * se3.hat(where - T[k][:, :3, 3])
            J[:, 3:, 3:] = sign * lever[:, None, None] * np.eye(3)
        blocks, rows, columns = [information], [np.arange(n)], [np.arange(n)]
        gradient = np.einsum("nij,nj->ni", information, se3.difference(T, start))
        for J, k in ((J_i, i), (J_j, j)):
            np.add.at(gradient, k, weight[:, None] * np.einsum("mji,mj->mi", J, error))
            for K, other in ((J_i, i), (J_j, j)):
                blocks.append(weight[:, None, None] * np.swapaxes(J, 1, 2) @ K)
                rows.append(k)
                columns.append(other)
        step = _solve(
            n, np.concatenate(blocks), np.concatenate(rows), np.concatenate(columns), gradient
        )
        T = se3.retract(T, step)
        if np.abs(step).max() < 1e-9:
            break
    return T


def _solve(
    n: int, blocks: Floats, rows: NDArray[np.int64], columns: NDArray[np.int64], gradient: Floats
) -> Floats:
    """Solve the block-sparse system for the step (n, 6); frame 0 stays."""
    keep = (rows > 0) & (columns > 0)
    blocks, rows, columns = blocks[keep], rows[keep] - 1, columns[keep] - 1
    six = np.arange(6)
    r = np.broadcast_to(6 * rows[:, None, None] + six[:, None], blocks.shape)
    c = np.broadcast_to(6 * columns[:, None, None] + six, blocks.shape)
    size = 6 * (n - 1)
    H = sparse.coo_matrix((blocks.ravel(), (r.ravel(), c.ravel())), (size, size)).tocsc()
    H = H + sparse.diags_array(1e-9 * np.maximum(H.diagonal(), 1e-12), format="csc")
    step = np.zeros((n, 6))
    step[1:] = -splu(H).solve(gradient[1:].ravel()).reshape(-1, 6)
    return step
