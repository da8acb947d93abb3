"""Hand-eye calibration without a board: X from depth and flange poses alone.

The frames are registered twice. At first the arm holds them: what all poses share, an error of X,
is as uncertain as the start, and the rest is as good as the arm. From there the depths alone say
where they were, and X and all that the robot gets wrong are fitted to that.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.dataset import Dataset
from depthba.dataset.sensor import HandEyeNoise, PoseNoise
from depthba.errors import OptionError
from depthba.optimiser.register import register
from depthba.options import Options as MapOptions
from depthba.result import Iteration, Result
from rig.hand_eye.depth.believed import Beliefs
from rig.hand_eye.depth.chain import Chain
from rig.hand_eye.depth.fit import Seen, Start, fit
from rig.hand_eye.depth.verdict import Status, judge
from rig.hand_eye.flanges import flange_poses, joint_motions, turned
from rig.hand_eye.record import Open

Array = NDArray[np.float64]

# Standard deviation of a joint's zero, rad, to begin with.
ZERO = 0.0005
# Points above which more add little: what limits the transform then is common to all of them.
ENOUGH = 1_000_000
# No arm whose joints are not known is taken to be better than this, m and rad.
ARM_T, ARM_R = 0.0003, 0.0005
# How far off the frames may be that the arm has held, m and rad: it says how coarse to begin.
NEAR_T, NEAR_R = 0.001, 0.001


@dataclass(frozen=True)
class Options:
    """How to calibrate from depth."""

    start_error: tuple[float, float] = (0.01, 1.0)
    """How far off the start may be along and about each axis: standard deviations, m and
    degrees."""
    robot_noise: tuple[float, float] = (0.00005, 0.01)
    """How well the robot repeats a flange pose: standard deviations along and about each axis, m
    and degrees. It is taken for worse where the depths say so."""
    resolution: float | None = None
    """Finest map spacing, m. None: what noise and spacing of the points call for."""
    threads: int | None = None
    """Threads of the kernels. None: all cores."""


@dataclass(frozen=True)
class HandEye:
    """A hand-eye transform, how certain it is, and whether to rely on it."""

    status: Status
    reason: str
    """One sentence for people."""
    T_flange_camera: Array
    """(4, 4), estimated."""
    T_flange_camera_start: Array
    """(4, 4)."""
    covariance: Array
    """(6, 6), translation along the flange's axes then rotation about them, m and rad, left
    perturbation about the camera centre."""
    open: tuple[Open, ...]
    """Directions that the data leave to the start."""
    turned: Array
    """(3,) rad, by how much the flange turned between frames (root mean square) about three axes,
    the largest first."""
    missed: Array
    """(N, 6), by which each flange is thought to be elsewhere than reported, base axes, m and
    rad."""
    zeros: Array
    """(n,), by which the joints' zeros are thought to be off, rad."""
    beliefs: Beliefs
    """How much each kind of error is thought to scatter."""
    registration: Result
    """Of the frames, on which it rests."""
    seconds: float

    @property
    def trusted(self) -> bool:
        """Whether the exit status is 0 (else 3: finished, but not to be trusted)."""
        return self.status == "converged"


def check(options: Options) -> None:
    """Refuse values that make no sense.

    Raises:
        OptionError: names the option, its value and what was expected.
    """
    for name in ("start_error", "robot_noise"):
        value = getattr(options, name)
        if not all(np.isfinite(v) and v > 0 for v in value):
            shown = " ".join(f"{v:g}" for v in value)
            raise OptionError(
                f"--{name.replace('_', '-')} {shown}: expected two numbers above 0, m and degrees"
            )
    if options.resolution is not None and not (
        np.isfinite(options.resolution) and options.resolution > 0
    ):
        raise OptionError(f"--resolution {options.resolution:g}: expected a number above 0")
    if options.threads is not None and options.threads < 1:
        raise OptionError(f"--threads {options.threads}: expected 1 or more")


def calibrate(
    dataset: Dataset,
    T_flange_camera: Array,
    options: Options | None = None,
    callback: Callable[[Iteration], None] | None = None,
) -> HandEye:
    """Estimate the hand-eye transform of a dataset with flange poses.

    Args:
        dataset: frames of one scene, each with the flange pose that the robot reported.
        T_flange_camera: (4, 4), the start.
        options: how; the defaults where None.
        callback: called after every iteration.

    Raises:
        DatasetError: the dataset is damaged, has fewer than 3 frames, or one without flange pose.
        OptionError: an option makes no sense.
    """
    options = options or Options()
    check(options)
    begin = time.perf_counter()
    chain = set_up(dataset, T_flange_camera)
    start_t, start_r = options.start_error[0], float(np.radians(options.start_error[1]))
    start = Start(T_flange_camera, np.repeat([start_t, start_r], 3))
    noise = options.robot_noise
    stated = Beliefs(start.sigma, ZERO, noise[0], float(np.radians(noise[1])))
    result = seen(dataset, chain, stated, options, callback)
    found = fit(chain, Seen.of(result), start, stated)
    chain, covariance = found.chain, found.covariance[:6, :6]
    ended = "" if found.converged else "the iterations ended before the transform settled"
    if result.status in ("not_converged", "no_better"):
        ended = f"the frames did not come together: {result.reason}"
    status, reason, left_open = judge(chain, covariance, start, found.beliefs, ended)
    return HandEye(
        status=status,
        reason=reason,
        T_flange_camera=chain.T_flange_camera,
        T_flange_camera_start=T_flange_camera,
        covariance=covariance,
        open=left_open,
        turned=turned(chain.T_base_flange)[0],
        missed=chain.missed + (chain.joints @ chain.zeros).reshape(-1, 6),
        zeros=chain.zeros,
        beliefs=found.beliefs,
        registration=result,
        seconds=time.perf_counter() - begin,
    )


def seen(
    dataset: Dataset,
    chain: Chain,
    stated: Beliefs,
    options: Options,
    callback: Callable[[Iteration], None] | None,
) -> Result:
    """Register the frames from where the chain has them, in the end by the depths alone."""
    t, r = arm_sigmas(chain, stated)
    shared = HandEyeNoise(_three(stated.start[0]), _three(stated.start[3]))
    held = replace(
        placed(dataset, chain.T_world_camera),
        pose_noise=PoseNoise(_three(t), _three(r), shared),
    )
    common = MapOptions(resolution=options.resolution, threads=options.threads, most_points=ENOUGH)
    first = register(held, common, callback)
    alone = replace(common, priors=False, prior_t=NEAR_T, prior_r=NEAR_R)
    return register(placed(dataset, first.T_world_camera), alone, callback)


def placed(dataset: Dataset, T_world_camera: Array) -> Dataset:
    """Return the dataset with measured poses (N, 4, 4) in place of its own."""
    frames = zip(dataset.frames, T_world_camera, strict=True)
    return replace(dataset, frames=tuple(replace(f, T_world_camera=T) for f, T in frames))


def arm_sigmas(chain: Chain, stated: Beliefs) -> tuple[float, float]:
    """Return how far off a flange may be along and about each axis, m and rad (rms)."""
    off = np.square(chain.joints * stated.zero).sum(axis=1).reshape(-1, 2, 3)
    t, r = np.sqrt(off.mean(axis=(0, 2)) + np.square([stated.robot_t, stated.robot_r]))
    return max(float(t), ARM_T), max(float(r), ARM_R)


def _three(value: float) -> tuple[float, float, float]:
    return (float(value),) * 3


def set_up(dataset: Dataset, T_flange_camera: Array) -> Chain:
    """Hang the cameras on the flanges.

    The base stands in the world as the measured poses say; that fixes the gauge and nothing else.

    Args:
        dataset: with flange poses.
        T_flange_camera: (4, 4), the start.
    """
    T_base_flange = flange_poses(dataset)
    behind = T_flange_camera if dataset.T_flange_camera is None else dataset.T_flange_camera
    joints = joint_motions(dataset, T_base_flange)
    return Chain(
        T_world_base=dataset[0].T_world_camera @ se3.inverse(T_base_flange[0] @ behind),
        T_base_flange=T_base_flange,
        T_flange_camera=T_flange_camera,
        missed=np.zeros((len(T_base_flange), 6)),
        joints=joints,
        zeros=np.zeros(joints.shape[1]),
    )
