"""The poses of a capture: what they are, and what the rig reports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.errors import OptionError
from sim.seeds import stream

Array = NDArray[np.float64]
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Track:
    """The poses of a capture."""

    stamps: Array
    """(N,) s."""
    T_world_camera_true: Array
    """(N, 4, 4)."""
    T_world_camera: Array
    """(N, 4, 4) as the rig reports them."""
    sigma_t: Triple | None = None
    """Believed standard deviation of the reported positions along world x, y, z, m; None: exact."""
    sigma_r: Triple | None = None
    """The same for rotations about world x, y, z, rad."""
    T_base_flange: Array | None = None
    """(N, 4, 4) as the encoders report it."""
    T_flange_camera: Array | None = None
    """(4, 4) the believed hand-eye transform."""
    T_flange_camera_true: Array | None = None
    """(4, 4) where the camera truly sits."""
    joints: Array | None = None
    """(N, n) joint positions as the encoders report them, rad."""
    qpos: Array | None = None
    """(N, nq) true positions of the model's joints in each frame; None: nothing in it moves."""


def perturbed(stamps: Array, T_true: Array, seed: int, start_error: tuple[float, float]) -> Track:
    """Reports with independent Gaussian errors per axis (m, rad), left perturbation; 0 is exact."""
    metres, radians = start_error
    if not (np.isfinite(start_error).all() and metres >= 0.0 and radians >= 0.0):
        raise OptionError(
            f"start-error {metres} {radians}: expected two numbers of 0 or more (m, rad)"
        )
    delta = stream(seed, "start-error").standard_normal((len(stamps), 6))
    delta *= np.repeat([metres, radians], 3)
    delta[0] = 0.0
    T = se3.retract(T_true, delta)
    T[0] = T_true[0]
    return Track(stamps, T_true, T, (metres,) * 3, (radians,) * 3)


def scaled(sigma: Triple, scale: float) -> Triple:
    """A standard deviation times a factor."""
    return (scale * sigma[0], scale * sigma[1], scale * sigma[2])
