"""From a dataset with flange poses to the problem that the optimiser's parts take."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.dataset import Dataset
from depthba.optimiser.problem import Problem, Roi, choose_map_frame, prepare
from rig.hand_eye.depth.chain import Chain
from rig.hand_eye.flanges import flange_poses, joint_motions

Array = NDArray[np.float64]

# Points above which more add nothing: what limits the transform then is common to all of them.
ENOUGH = 1_000_000
# Points that are this many times as noisy as the typical one are left out.
NOISY = 3.0


def set_up(dataset: Dataset, T_flange_camera: Array, sigma: Array) -> tuple[Problem, Chain]:
    """Read the points, and hang the cameras on the flanges.

    The base stands in the world as the measured poses say; that fixes the gauge and nothing else.

    Args:
        dataset: with flange poses.
        T_flange_camera: (4, 4), the start.
        sigma: (6,) m and rad, how far off it may be.
    """
    T_base_flange = flange_poses(dataset)
    behind = T_flange_camera if dataset.T_flange_camera is None else dataset.T_flange_camera
    T_world_base = dataset[0].T_world_camera @ se3.inverse(T_base_flange[0] @ behind)
    T_world_camera = T_world_base @ T_base_flange @ T_flange_camera
    problem = prepare(dataset, T_world_camera, near_box(dataset, T_world_camera, sigma))
    reach = 2 * displaced(sigma, problem.ranges)
    total = sum(len(f) for f in problem.frames)
    stride = max(1, total // ENOUGH)
    problem = replace(
        problem.thinned(stride),
        spacing=problem.spacing * float(np.sqrt(stride)),
        lower=problem.lower - reach,
        upper=problem.upper + reach,
    )
    missed = np.zeros((len(T_base_flange), 6))
    joints = joint_motions(dataset, T_base_flange)
    chain = Chain(
        T_map_base=problem.T_map_world @ T_world_base,
        T_base_flange=T_base_flange,
        T_flange_camera=T_flange_camera,
        missed=missed,
        joints=joints,
        zeros=np.zeros(joints.shape[1]),
    )
    return problem, chain


def displaced(sigma: Array, ranges: float) -> float:
    """Return by how much an error of X, (6,) m and rad, moves a point at a distance, m."""
    return float(np.hypot(sigma[:3].max(), sigma[3:].max() * ranges))


def near_box(dataset: Dataset, T_world_camera: Array, sigma: Array) -> Roi | None:
    """Return the box in the map frame that holds the points of usual noise; None without noise.

    A floor behind the table would stretch the map, and coarsen it, for points that say little.

    Args:
        dataset: the frames.
        T_world_camera: (N, 4, 4), the start.
        sigma: (6,) m and rad, how far off it may be.
    """
    noise = dataset.sensor.noise
    clouds = [frame.points() for frame in dataset]
    if noise is None or not any(len(p) for p in clouds):
        return None
    some = [p[:: max(1, len(p) // 20000)].astype(float) for p in clouds]
    sigmas = [noise.sigma(p[:, 2]) for p in some]
    limit = NOISY * float(np.median(np.concatenate(sigmas)))
    T_map_camera = choose_map_frame(dataset.map_frame, clouds, T_world_camera) @ T_world_camera
    near = np.concatenate(
        [
            p[s <= limit] @ T[:3, :3].T + T[:3, 3]
            for p, s, T in zip(some, sigmas, T_map_camera, strict=True)
        ]
    )
    reach = 2 * displaced(sigma, float(np.median(np.concatenate([p[:, 2] for p in some]))))
    low, high = np.quantile(near, [0.001, 0.999], axis=0)
    low, high = low - reach, high + reach
    return (
        float(low[0]), float(high[0]), float(low[1]), float(high[1]), float(low[2]), float(high[2])
    )  # fmt: skip
