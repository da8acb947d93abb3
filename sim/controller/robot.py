"""The arm, its modes and its safety system, as a controller of the e-Series shows them."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import se3
from depthba.errors import OutOfReach
from depthba.kinematics import DhArm
from depthba.straight import flange, straight
from sim.controller.motion import JointPath, LinePath, Motion
from sim.controller.surroundings import Surroundings
from sim.engine import mujoco

Array = NDArray[np.float64]

STEP = 0.002
"""The control loop's own step, s of simulated time."""


class RobotMode(IntEnum):
    """As RTDE's robot_mode."""

    POWER_OFF = 3
    RUNNING = 7


class SafetyMode(IntEnum):
    """As RTDE's safety_mode."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7


class Runtime(IntEnum):
    """As RTDE's runtime_state."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


SAFETY_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}
"""RTDE's safety_status_bits: 0 normal, 2 protective stop, 6 robot and 7 any emergency stop, 10
stopped by safety."""


class ScriptError(Exception):
    """The program asks for what no controller can do; it ends there."""


@dataclass
class Robot:
    """One arm and the state of its controller. Time passes only in `advance`."""

    dh: DhArm
    surroundings: Surroundings
    encoders: Array
    """(n,) joints as the encoders read them, rad."""
    zeros: Array
    """(n,) by which the encoders read too much, rad: nobody but the simulation knows."""
    remote: bool = True
    """Whether a program from outside is obeyed: not in local mode."""
    slider: float = 1.0
    """The speed slider, 0 to 1."""
    time: float = 0.0
    """Since the controller was started, s."""
    velocities: Array = field(default_factory=lambda: np.zeros(6))
    """(n,) rad/s."""
    T_flange_tcp: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4)."""
    robot_mode: RobotMode = RobotMode.RUNNING
    safety: SafetyMode = SafetyMode.NORMAL
    runtime: Runtime = Runtime.STOPPED
    motion: Motion | None = None
    free: bool = False
    """In free drive: a hand may move the arm."""
    notes: list[str] = field(default_factory=list)
    """What the teach pendant would show; emptied by who prints it."""

    def __post_init__(self) -> None:
        """Take the kinematics apart."""
        self._links = self.dh.links()
        self._tcp: tuple[bytes, list[float]] = b"", []

    @property
    def joints(self) -> Array:
        """(n,) where the joints truly are, rad."""
        return self.encoders - self.zeros

    @property
    def T_base_tcp(self) -> Array:
        """(4, 4) by the encoders, as the controller believes."""
        return flange(self._links, self.encoders) @ self.T_flange_tcp

    @property
    def tcp(self) -> list[float]:
        """The same as the controller writes it: x y z rx ry rz, m and rad."""
        key = self.encoders.tobytes() + self.T_flange_tcp.tobytes()
        if self._tcp[0] != key:
            self._tcp = key, pose_vector(self.T_base_tcp).tolist()
        return self._tcp[1]

    # Time

    def advance(self, dt: float) -> None:
        """Let `dt` s pass."""
        self.time += dt
        left = dt
        while self.motion is not None and left > 0.0:
            step = min(left, STEP)
            left -= step
            q, self.velocities, over = self.motion.advance(step * self.slider)
            self.velocities = self.velocities * self.slider
            met = self.surroundings.met(q - self.zeros)
            if met is not None:
                self.protective_stop(f"{met[0]} ran against {met[1]}")
                return
            self.encoders = q
            if over:
                self.motion, self.velocities = None, np.zeros(len(q))

    # Motion

    def move_joints(self, goal: ArrayLike, speed: float, acceleration: float) -> None:
        """Start to joints (n,), rad; a protective stop where they break a limit."""
        goal = _finite("movej", goal, speed, acceleration)
        if not self.dh.within_limits(goal):
            self._refuse(goal)
            return
        self.motion = Motion(JointPath(self.encoders, goal), speed, acceleration)

    def move_line(
        self, T_base_tcp: ArrayLike, speed: float, acceleration: float, joints: Array | None = None
    ) -> None:
        """Start along a line of the tool to a pose (4, 4); `joints` (n,) are those it ends in.

        A protective stop where a joint would break a limit, ScriptError where nothing leads there.
        """
        T = _finite("movel", T_base_tcp, speed, acceleration)
        try:
            line = straight(self.dh, self.encoders, T @ se3.inverse(self.T_flange_tcp))
        except OutOfReach as error:
            self.protective_stop(f"movel: {error}")
            return
        if joints is not None and np.abs(line.joints[-1] - joints).max() > 1e-6:
            raise ScriptError("movel: the line ends in another posture than was asked for")
        self.motion = Motion(LinePath(line, joints), speed, acceleration)

    def brake(self, deceleration: float) -> None:
        """Stop on the way."""
        if self.motion is not None:
            self.motion.brake(deceleration)

    def place(self, joints: ArrayLike) -> None:
        """Move the arm by hand to encoder readings (n,), at once."""
        joints = np.asarray(joints, float)
        if joints.shape != self.encoders.shape or not self.dh.within_limits(joints):
            raise ValueError(f"joints {joints.tolist()}: expected 6 within the limits")
        self._halt()
        self.encoders = joints.copy()

    def inverse(self, T_base_tcp: Array, near: Array) -> Array:
        """Joints (n,) for a pose (4, 4) of the tool, from those `near`; ScriptError: none."""
        q = None
        if np.isfinite(T_base_tcp).all() and np.isfinite(near).all():
            q = self.dh.inverse(T_base_tcp @ se3.inverse(self.T_flange_tcp), near, 1e-10)
        if q is None:
            raise ScriptError("get_inverse_kin: no joints reach the pose")
        return q

    def _refuse(self, goal: Array) -> None:
        k = int(np.argmax(np.maximum(goal - self.dh.upper, np.subtract(self.dh.lower, goal))))
        self.protective_stop(
            f"{self.dh.joints[k]} asked for {goal[k]:.3f} rad, its limits are"
            f" {self.dh.lower[k]:.3f} and {self.dh.upper[k]:.3f}"
        )

    def _halt(self) -> None:
        self.motion, self.velocities = None, np.zeros(len(self.encoders))

    # Safety

    def protective_stop(self, why: str) -> None:
        """Brake at once and wait for somebody to look."""
        self.notes.append(f"protective stop: {why}")
        self._halt()
        self.safety = SafetyMode.PROTECTIVE_STOP
        if self.runtime == Runtime.PLAYING:
            self.runtime = Runtime.PAUSED

    def emergency_stop(self) -> None:
        """Power off."""
        self.notes.append("emergency stop")
        self._halt()
        self.safety, self.robot_mode = SafetyMode.ROBOT_EMERGENCY_STOP, RobotMode.POWER_OFF
        self.runtime = Runtime.STOPPED

    def release(self) -> None:
        """After somebody looked: back to normal, powered, the program stopped."""
        self.safety, self.robot_mode = SafetyMode.NORMAL, RobotMode.RUNNING
        self.runtime = Runtime.STOPPED

    @property
    def obeys(self) -> bool:
        """Whether a program may run."""
        return self.remote and (self.robot_mode, self.safety) == (
            RobotMode.RUNNING,
            SafetyMode.NORMAL,
        )

    def halt_program(self) -> None:
        """End the program; the arm stops."""
        self._halt()
        if self.runtime != Runtime.STOPPED:
            self.runtime = Runtime.STOPPED


def _finite(what: str, target: ArrayLike, speed: float, acceleration: float) -> Array:
    target = np.asarray(target, float)
    if not np.isfinite(target).all():
        raise ScriptError(f"{what}: the target is not finite")
    if not (0.0 < speed < np.inf and 0.0 < acceleration < np.inf):
        raise ScriptError(f"{what}: speed {speed}, acceleration {acceleration}, expected above 0")
    return target


def pose_vector(T: Array) -> Array:
    """A pose (4, 4) as the controller writes it: x y z rx ry rz (6,), m and rad."""
    # Every cycle needs one: MuJoCo's own are fifty times quicker than those for batches.
    p, quaternion = np.empty(6), np.empty(4)
    p[:3] = T[:3, 3]
    mujoco.mju_mat2Quat(quaternion, T[:3, :3].ravel())
    mujoco.mju_quat2Vel(p[3:], quaternion, 1.0)
    return p


def pose_matrix(p: ArrayLike) -> Array:
    """A pose x y z rx ry rz (6,), m and rad, as (4, 4)."""
    p = np.asarray(p, float)
    return se3.make(se3.exp_so3(p[3:]), p[:3])
