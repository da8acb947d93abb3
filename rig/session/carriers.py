"""One face for what carries the camera: an arm, or a gantry."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.errors import OptionError
from rig.arms.arm import Arm, Safety
from rig.axes.axes import Axes, AxesState
from rig.errors import AxesError, EmergencyStop, ProtectiveStop, RigError, Stopped
from rig.session.options import Motion, RigChoice
from rig.session.workspace import Body

Array = NDArray[np.float64]

_POLL = 0.02
_STOPS: dict[Safety, type[Stopped]] = {
    Safety.PROTECTIVE_STOP: ProtectiveStop,
    Safety.EMERGENCY_STOP: EmergencyStop,
    Safety.SAFEGUARD_STOP: Stopped,
    Safety.FAULT: Stopped,
}


@dataclass(frozen=True, eq=False)
class Standing:
    """One instant: everything in it belongs together."""

    stamp: float
    """The controller's clock where it tells it, else the host's, s."""
    joints: Array
    """(n,) rad or m."""
    T_base_flange: Array
    """(4, 4) from the joints."""
    speed: float
    """Of the fastest joint, rad/s or m/s; inf where all that is known is that it moves."""
    known: bool = True
    """Whether the joints mean anything: not those of a gantry before it was homed."""


class Carrier(Protocol):
    """What carries the camera. Raises `rig.errors.RigError` or one of its kinds."""

    body: Body
    who: str
    """For messages."""

    def connect(self) -> None:
        """Reach it; nothing moves."""

    def make_ready(self) -> None:
        """Do what must be done before the first move; this may move it."""

    def state(self) -> Standing:
        """Where it is now; Stopped while a safety stop holds it."""

    def move(self, target: Array) -> None:
        """Go to joints (n,), and return once it stands there."""

    def stop(self) -> None:
        """Brake. Never raises."""

    def disconnect(self) -> None:
        """Let go of it. Never raises."""

    @property
    def warnings(self) -> list[str]:
        """What somebody should be told, a line each."""


class ArmCarrier:
    """An arm; the flange's pose comes from the joints by its own kinematics."""

    def __init__(self, arm: Arm, motion: Motion, who: str) -> None:
        """Nothing is reached yet."""
        self._arm, self._motion, self.who = arm, motion, who
        dh = arm.dh
        self.body = Body(
            dh.joints, np.array(dh.lower), np.array(dh.upper), "rad", dh.forward, arm=dh
        )

    @property
    def warnings(self) -> list[str]:
        """See `Carrier`."""
        return list(getattr(self._arm, "warnings", []))

    def connect(self) -> None:
        """See `Carrier`."""
        self._arm.connect()

    def make_ready(self) -> None:
        """See `Carrier`: an arm that is connected is ready."""

    def state(self) -> Standing:
        """See `Carrier`."""
        found = self._arm.state()
        if found.safety in _STOPS:
            raise _STOPS[found.safety](
                f"{self.who}: {found.safety.value}; expected a person to look at the robot and"
                " release it"
            )
        speed = float(np.abs(found.velocities).max())
        return Standing(found.stamp, found.joints, found.T_base_flange, speed)

    def move(self, target: Array) -> None:
        """See `Carrier`."""
        pace: dict[str, Any] = {
            "speed": self._motion.speed,
            "acceleration": self._motion.acceleration,
        }
        if self._motion.move == "linear":
            self._arm.move_linear(self.body.forward(target), **pace)
        else:
            self._arm.move_joints(target, **pace)

    def stop(self) -> None:
        """See `Carrier`."""
        self._arm.stop()

    def disconnect(self) -> None:
        """See `Carrier`."""
        self._arm.disconnect()


class AxesCarrier:
    """A gantry, which moves its carriage along directions of the base frame."""

    def __init__(
        self, axes: Axes, directions: tuple[tuple[float, ...], ...], motion: Motion, who: str
    ) -> None:
        """Nothing is reached yet; OptionError where axes lack a direction."""
        self._axes, self._motion, self.who = axes, motion, who
        if len(directions) < len(axes.axes):
            raise OptionError(
                f"rig.directions: {len(directions)}, expected one for each of the axes:"
                f" {', '.join(axis.name for axis in axes.axes)}"
            )
        along = np.array(directions[: len(axes.axes)], float)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        self.body = Body(
            tuple(axis.name for axis in axes.axes),
            np.array([axis.lower for axis in axes.axes]),
            np.array([axis.upper for axis in axes.axes]),
            "m",
            lambda p: se3.make(np.eye(3), np.asarray(p) @ along),
        )

    @property
    def warnings(self) -> list[str]:
        """See `Carrier`."""
        return []

    def connect(self) -> None:
        """See `Carrier`."""
        self._axes.connect()

    def make_ready(self) -> None:
        """See `Carrier`: axes that do not know where they are find their switches."""
        if not self._axes.status().homed:
            self._axes.home()

    def state(self) -> Standing:
        """See `Carrier`."""
        found = self._axes.status()
        self._refuse_alarm(found)
        speed = float("inf") if found.moving else 0.0
        T = self.body.forward(found.position)
        return Standing(found.stamp, found.position, T, speed, known=found.homed)

    def _refuse_alarm(self, found: AxesState) -> None:
        if found.alarm is not None:
            raise AxesError(f"{self.who}: alarm: {found.alarm}")

    def move(self, target: Array) -> None:
        """See `Carrier`."""
        self._axes.move_to(target, speed=self._motion.speed)

    def stop(self) -> None:
        """See `Carrier`."""
        self._axes.stop()

    def disconnect(self) -> None:
        """See `Carrier`."""
        self._axes.disconnect()


def make_carrier(rig: RigChoice, motion: Motion) -> Carrier:
    """Return what a session's rig names; nothing is reached yet. OptionError: it makes no sense."""
    if rig.kind == "ur":
        from rig.arms.ur import UrArm

        return ArmCarrier(UrArm(rig.options), motion, rig.options.host)
    axes: Axes
    if rig.kind == "modbus":
        from rig.axes.modbus import ModbusGantry

        axes = ModbusGantry(rig.options)
        who = f"{rig.options.host}:{rig.options.port}"
    else:
        from rig.axes.grbl import GrblGantry

        axes = GrblGantry(rig.options)
        who = str(rig.options.port)
    return AxesCarrier(axes, rig.directions, motion, who)


def await_still(carrier: Carrier, motion: Motion) -> Standing:
    """Wait until it stands; RigError after `motion.still_timeout` s."""
    deadline = time.monotonic() + motion.still_timeout
    while True:
        found = carrier.state()
        if found.speed <= motion.still:
            return found
        if time.monotonic() > deadline:
            raise RigError(
                f"{carrier.who}: moves at {found.speed:.3g} {carrier.body.unit}/s after its move,"
                f" expected it to stand within {motion.still_timeout:g} s"
            )
        time.sleep(_POLL)
