"""Where the poses start, and how far they are believed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba.dataset import Dataset
from depthba.dataset.sensor import PoseNoise
from depthba.errors import OptionError
from depthba.options import Options
from depthba.trajectory import read_tum

# Standard deviations of a measured pose where the dataset states none: a rig that was set up with
# some care.
USUAL_T, USUAL_R = 0.01, 0.02


def start_poses(dataset: Dataset, options: Options) -> NDArray[np.float64]:
    """Return (N, 4, 4) T_world_camera to start from.

    Measured, identity, from pairs of frames, or a TUM file joined by stamp.
    """
    init, measured = options.init, dataset.T_world_camera_measured
    if init == "measured":
        return measured
    if init == "identity":
        return np.repeat(measured[:1], len(measured), axis=0)
    if init == "pairwise":
        from depthba.pairwise import dataset_poses

        sigma_t, sigma_r = reach_of_poses(dataset.pose_noise, options)
        return dataset_poses(dataset, sigma_t, sigma_r, options.threads).T_world_camera
    if not Path(init).is_file():
        raise OptionError(
            f"--init {init}: expected measured, identity, pairwise or a file of poses that is there"
        )
    stamps, poses = read_tum(init)[:2]
    found = []
    for frame in dataset:
        same = np.flatnonzero(np.abs(stamps - frame.stamp) <= 1e-6)
        if len(same) != 1:
            raise OptionError(
                f"--init {init}: {len(same)} poses for frame {frame.id} at stamp {frame.stamp:.6f}"
            )
        found.append(poses[same[0]])
    return np.stack(found)


def hand_eye_sigmas(
    noise: PoseNoise | None, options: Options
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the standard deviations (3,) m and (3,) rad of what all measured poses share.

    None where the dataset states none, or options speak of the measured poses themselves.
    """
    if noise is None or noise.hand_eye is None:
        return None
    if options.prior_t is not None or options.prior_r is not None:
        return None
    shared = noise.hand_eye
    t, r = np.array(shared.sigma_t_m, dtype=float), np.array(shared.sigma_r_rad, dtype=float)
    return np.maximum(t, 1e-6), np.maximum(r, 1e-6)


def reach_of_poses(
    noise: PoseNoise | None, options: Options
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the standard deviations (3,) m and (3,) rad of poses, with what they share."""
    own, shared = pose_sigmas(noise, options), hand_eye_sigmas(noise, options)
    if shared is None:
        return own
    # the camera's axes lie in the world as they may: the largest stands for all
    t, r = (np.hypot(a, b.max()) for a, b in zip(own, shared, strict=True))
    return t, r


def pose_sigmas(
    noise: PoseNoise | None, options: Options
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the standard deviations (3,) m and (3,) rad of the measured poses, each for itself.

    Options, dataset, or usual ones.
    """
    sigma_t = np.array(noise.sigma_t_m if noise else (USUAL_T,) * 3, dtype=float)
    sigma_r = np.array(noise.sigma_r_rad if noise else (USUAL_R,) * 3, dtype=float)
    # an axis stated without error still gets a trace of it: no axis is perfect
    sigma_t, sigma_r = np.maximum(sigma_t, 1e-6), np.maximum(sigma_r, 1e-6)
    if options.prior_t is not None:
        sigma_t = np.full(3, options.prior_t)
    if options.prior_r is not None:
        sigma_r = np.full(3, options.prior_r)
    return sigma_t, sigma_r
