"""Patches at work: alone between the coarse maps and the finest one, and beside that.

A map draws frames together from afar, but what it cannot hold keeps them a little off: small and
steep things, of which a scene may have little else that holds the frames sideways. Patches follow
those, and all the rest too, in a few rounds: lay them, step the poses until they settle, lay them
anew. In each round a pose is held at where it was by the information of its measured pose, so that
nothing slides that no patch holds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser.layers import rough_points
from depthba.optimiser.laying import Cloud, lay
from depthba.optimiser.patches import Fit
from depthba.optimiser.prior import PosePrior, PriorAt, move
from depthba.optimiser.problem import Problem
from depthba.optimiser.workers import Workers

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Round:
    """How patches are laid."""

    sides: tuple[float, ...]
    """Of the voxels, in spacings of the finest map."""
    robust: float
    """Scale of the loss, in robust standard deviations of the residuals."""
    along_ray: bool
    """Whether residuals are taken along the ray; across the surface they vary less where it is
    steep, which is worth more than what noise in the normals costs while frames are misaligned."""


# Two spacings of a coarse map may be left between frames: smaller voxels would tie what is not
# the same.
FAR = Round((4.0,), 10.0, along_ray=False)
NEAR = Round((2.5,), 10.0, along_ray=False)
CLOSE = Round((3.3, 1.7), 3.5, along_ray=True)
ROUNDS = (FAR, FAR, NEAR, NEAR, CLOSE)
# Points beyond which every so many are left out, alone and beside a map, which takes them all.
MOST, MOST_BESIDE = 500_000, 12_000_000
# Most steps in a round, and how many standard deviations one is long when they have settled.
STEPS, SETTLED = 8, 0.1
# Largest median distance of a patch's points from its surface beside a map, in deviations of the
# noise.
TRUE = 1.0
# Weight of a point in a patch beside a map whose cell takes it at its full weight, too.
SHARED = 0.5
# Standard deviation of the noise where none is stated, in spacings of the points.
SUPPOSED = 0.02


def tied_by_patches(
    problem: Problem, poses: Array, spacing: float, prior: PosePrior, acting: PosePrior,
    inflation: float, free: NDArray[np.bool_], workers: Workers,
) -> Array:  # fmt: skip
    """Return poses (N, 4, 4) ``T_map_camera`` that agree with the patches.

    Args:
        problem: the points.
        poses: (N, 4, 4) where to start.
        spacing: that the voxels go by, m: of the finest map, or of a finer one.
        prior: the measured poses, whose information holds what no patch does.
        acting: the measured poses as they enter the cost.
        inflation: factor on the variance of what the points say, for their correlation.
        free: (N,) frames that move.
        workers: the threads.
    """
    stride = -(-sum(map(len, problem.frames)) // MOST)
    cloud = Cloud.of(problem.thinned(stride))
    # as many points in a voxel as all of them have at its own spacing
    spacing = spacing * float(np.sqrt(stride))
    sigma = problem.noise or SUPPOSED * problem.spacing
    for now in ROUNDS:
        sides = tuple(s * spacing for s in now.sides)
        points = replace(cloud, rays=cloud.rays and now.along_ray)
        tied = lay(points, poses, sides, now.robust, sigma, workers)
        if not len(tied.patches):
            return poses
        near = replace(prior, T_map_camera=poses, gauge=None)
        poses = _settled(problem, poses, tied, (near, acting), inflation, free, workers, sigma)
    return poses


def _settled(
    problem: Problem, poses: Array, tied: Fit, priors: tuple[PosePrior, ...],
    inflation: float, free: NDArray[np.bool_], workers: Workers, sigma: float,
) -> Array:  # fmt: skip
    """Step the poses on patches that stay where they are (Levenberg-Marquardt)."""
    centroids = np.stack([f.centroid for f in problem.frames])
    keep, damping = np.repeat(free, 6), 0.0
    variance = inflation * (tied.patches.deviation) ** 2

    def held_at(T: Array) -> list[PriorAt]:
        return [p.at(T) for p in priors]

    held = held_at(poses)
    for _ in range(STEPS):
        pivots = np.einsum("nij,nj->ni", poses[:, :3, :3], centroids) + poses[:, :3, 3]
        A, g = tied.patches.normal_equations(poses, pivots, workers)
        for at in held:
            matrix, gradient = at.normal_equations(pivots)
            A, g = A + variance * matrix, g + variance * gradient
        before = tied.cost + variance * sum(at.cost for at in held)
        A = A[np.ix_(keep, keep)]
        step = np.zeros(len(keep))
        x = -np.linalg.solve(A + np.diag((1e-9 + damping) * np.diag(A)), g.ravel()[keep])
        step[keep] = x
        candidate = move(poses, pivots, step.reshape(-1, 6))
        fit = tied.patches.fitted(candidate, workers)
        held_there = held_at(candidate)
        after = fit.cost + variance * sum(at.cost for at in held_there)
        if after > before * (1 + 1e-6):
            damping = max(10 * damping, 1e-3)
            continue
        poses, damping = candidate, damping / 10 if damping > 1e-4 else 0.0
        tied, held = fit, held_there
        if x @ A @ x < SETTLED**2 * len(x) * variance:
            break
    return poses


def patches_beside(
    problem: Problem, T_map_camera: Array, spacing: float, fine: float, robust: float,
    sigma: float, workers: Workers, shared: float = SHARED,
) -> Fit | None:  # fmt: skip
    """Return patches over what is steep, fitted at the poses (N, 4, 4); None: nothing.

    Only such whose points lie on them but for noise: the map's cells say the rest better.

    Args:
        problem: the points.
        T_map_camera: (N, 4, 4).
        spacing: of the map, m.
        fine: the spacing that the voxels go by, m.
        robust: scale of the loss, in robust standard deviations of the residuals.
        sigma: standard deviation of the points' noise, m.
        workers: the threads.
        shared: weight of the points that the map takes at their full weight, too.
    """
    stride = -(-sum(map(len, problem.frames)) // MOST_BESIDE)
    some = problem.thinned(stride)
    rough = np.concatenate(rough_points(some, T_map_camera, spacing, workers))
    sides = tuple(s * fine * float(np.sqrt(stride)) for s in CLOSE.sides)
    cloud = Cloud.of(some)
    cloud = replace(cloud, source=stride * cloud.source)
    cloud = cloud.weighed(np.where(rough, 1.0, shared), workers)
    laid = lay(cloud, T_map_camera, sides, robust, sigma, workers).true(TRUE * sigma, workers)
    return laid.fitted(T_map_camera, workers).rescaled(sigma) if len(laid) else None
