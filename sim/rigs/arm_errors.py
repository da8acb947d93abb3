"""What an arm reports of its poses: encoders, repeatability, believed hand-eye transform."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.kinematics import DhArm
from sim.errors import SimulationError
from sim.rigs.track import Triple
from sim.seeds import stream

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ArmErrors:
    """Standard deviations of what an arm gets wrong."""

    joint_offset: float = 0.0002
    """Of each joint's zero, constant over the capture, rad (0.05 mm is repeatability, not
    accuracy)."""
    repeat_t: float = 0.00005
    """Of the flange's place each time, along each axis, m (data sheet)."""
    repeat_r: float = float(np.radians(0.01))
    """Of the flange's orientation each time, about each axis, rad."""
    hand_eye_t: float = 0.002
    """Of the camera's place on the flange, the same in all frames, m."""
    hand_eye_r: float = float(np.radians(0.3))
    """Of the camera's orientation on the flange, the same in all frames, rad."""


@dataclass(frozen=True)
class Reports:
    """What the arm and its user believe of a capture."""

    joints: Array
    """(N, n) rad."""
    T_base_flange: Array
    """(N, 4, 4) the forward kinematics of `joints`."""
    T_flange_camera: Array
    """(4, 4)."""
    sigma_t: Triple
    """Standard deviation of the camera's reported place along world x, y, z, m."""
    sigma_r: Triple
    """The same about world x, y, z, rad."""


def report(
    arm: DhArm,
    q: Array,
    T_world_base: Array,
    T_flange_camera: Array,
    errors: ArmErrors,
    seed: int,
    scale: float = 1.0,
) -> Reports:
    """Draw the reports of a capture at true joints `q` (N, n); `scale` multiplies every error.

    SimulationError if errors so large leave the arm's reach.
    """
    rng = stream(seed, "arm-errors")
    n = len(arm.joints)
    q_encoders = q + scale * errors.joint_offset * rng.standard_normal(n)
    spread = np.repeat([errors.repeat_t, errors.repeat_r], 3)
    missed = scale * spread * rng.standard_normal((len(q), 6))
    joints, right = arm.solve(se3.retract(arm.forward(q_encoders), missed), q_encoders)
    if not right.all():
        frame = int(np.flatnonzero(~right)[0])
        raise SimulationError(
            f"pose noise {scale}: no joints give the pose that frame {frame} would report;"
            " expected less noise"
        )
    wrong = np.repeat([errors.hand_eye_t, errors.hand_eye_r], 3) * rng.standard_normal(6)
    sigma = scale * np.sqrt(_variance(arm, q, T_world_base, T_flange_camera, errors))
    return Reports(
        joints,
        arm.forward(joints),
        se3.retract(T_flange_camera, scale * wrong),
        (float(sigma[0]), float(sigma[1]), float(sigma[2])),
        (float(sigma[3]), float(sigma[4]), float(sigma[5])),
    )


def _variance(
    arm: DhArm, q: Array, T_world_base: Array, T_flange_camera: Array, errors: ArmErrors
) -> Array:
    """Of the reported camera poses (6,), world axes, the mean over the frames."""
    R_world_base = T_world_base[:3, :3]
    lever = (arm.forward(q)[:, :3, :3] @ T_flange_camera[:3, 3]) @ R_world_base.T
    J = arm.jacobian(q)
    J_t, J_r = R_world_base @ J[:, :3], R_world_base @ J[:, 3:]
    # A turn of the flange moves the camera by w x lever.
    swing = -se3.hat(lever)
    joints = np.concatenate([J_t + swing @ J_r, J_r], axis=1)
    variance = errors.joint_offset**2 * np.square(joints).sum(axis=-1).mean(axis=0)
    variance[:3] += errors.repeat_t**2 + errors.hand_eye_t**2
    variance[:3] += errors.repeat_r**2 * np.square(swing).sum(axis=-1).mean(axis=0)
    variance[3:] += errors.repeat_r**2 + errors.hand_eye_r**2
    return np.asarray(variance)
