"""The interface of an arm that carries a camera."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba.kinematics import DhArm

Array = NDArray[np.float64]


class Safety(Enum):
    """What the arm's safety system says."""

    NORMAL = "normal"
    REDUCED = "reduced"
    PROTECTIVE_STOP = "protective stop"
    SAFEGUARD_STOP = "safeguard stop"
    EMERGENCY_STOP = "emergency stop"
    FAULT = "fault"


@dataclass(frozen=True, eq=False)
class ArmState:
    """One instant of an arm: everything in it belongs to one message of the controller."""

    stamp: float
    """The controller's clock, s."""
    joints: Array
    """(n,) rad."""
    velocities: Array
    """(n,) rad/s."""
    T_base_flange: Array
    """(4, 4) by `Arm.dh` from `joints`; never the controller's own."""
    safety: Safety
    remote: bool
    """Whether the controller obeys a program from outside."""


class Arm(Protocol):
    """An arm of rotary joints. Raises `rig.errors.ArmError` or one of its kinds, nothing else.

    A move returns once the arm stands at its target, checked by its joints; it raises
    `rig.errors.Stopped` as soon as a safety stop shows. No target leaves for the robot before its
    length, finiteness and limits were checked.
    """

    @property
    def dh(self) -> DhArm:
        """The kinematics that turn joints into flange poses, calibrated where the arm's are."""

    def connect(self) -> None:
        """Reach the controller and see that it can be driven. Ends in time whatever is there."""

    def state(self) -> ArmState:
        """The newest instant. ArmError where none came for longer than the link allows."""

    def move_joints(self, target: ArrayLike, *, speed: float, acceleration: float) -> ArmState:
        """Go to joints (n,), rad; all joints arrive together.

        Args:
            target: joints (n,), rad.
            speed: of the fastest joint, rad/s.
            acceleration: of the fastest joint, rad/s^2.

        Returns:
            the state once the arm stands.
        """

    def move_linear(self, target: ArrayLike, *, speed: float, acceleration: float) -> ArmState:
        """Go to a flange pose T_base_flange (4, 4) along a straight line, m/s and m/s^2."""

    def stop(self) -> None:
        """Brake now, and end the move that is under way in another thread. Never raises."""

    def disconnect(self) -> None:
        """Let go of the controller. Safe to call twice, and after a failure."""
