"""An arm of Universal Robots, driven through ur-rtde.

The library runs in a process of its own (`rig.arms.ur_child`). Moves are started and then watched:
by the controller's clock, whether the data still flow; by the safety bits, whether a stop holds the
arm; by the joints, whether it is where it was sent. Poses come from the joints by our own
kinematics, never from the controller.
"""

from __future__ import annotations

import contextlib
import importlib.util
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba.errors import OptionError, OutOfReach
from depthba.kinematics import UR16E, DhArm
from depthba.straight import straight
from depthba.ur_calibration import read_calibration
from rig.arms.arm import ArmState, Safety
from rig.arms.targets import check_rate, checked_joints, checked_pose
from rig.arms.ur_link import Link, Lost, Refused
from rig.arms.ur_preflight import Greeting, ask_dashboard, preflight, refuse_stop
from rig.errors import ArmError, EmergencyStop, ProtectiveStop, Stopped

Array = NDArray[np.float64]

_PLAYING = 2
"""RTDE's runtime_state of a running program."""
_RUNNING = 7
"""RTDE's robot_mode of an arm that is powered, its brakes open."""
_POLL = 0.002
"""Between two looks for a new package, s."""
_STILL = 0.005
"""A joint slower than that stands, rad/s."""
_SHORT_OF = 1.0
"""An arm that has stood so long away from its target, its move over, has missed it, s."""
_SAMPLES = 3
"""Consecutive instants in which it must stand at its target."""

_SAFETY = (
    # RTDE's safety_status_bits, the gravest first: 9 fault, 8 violation, 5 to 7 emergency stops,
    # 2 protective stop, 4 safeguard stop, 3 recovery, 10 stopped for another reason, 1 reduced.
    (1 << 9 | 1 << 8, Safety.FAULT),
    (1 << 5 | 1 << 6 | 1 << 7, Safety.EMERGENCY_STOP),
    (1 << 2, Safety.PROTECTIVE_STOP),
    (1 << 4, Safety.SAFEGUARD_STOP),
    (1 << 3 | 1 << 10, Safety.FAULT),
    (1 << 1, Safety.REDUCED),
)
_KINDS: dict[Safety, type[Stopped]] = {
    Safety.PROTECTIVE_STOP: ProtectiveStop,
    Safety.EMERGENCY_STOP: EmergencyStop,
    Safety.SAFEGUARD_STOP: Stopped,
    Safety.FAULT: Stopped,
}


@dataclass(frozen=True)
class UrOptions:
    """How to reach and to drive an arm."""

    host: str
    """Address of the controller; its ports are fixed."""
    calibration: Path | None = None
    """The arm's calibration.conf, from the controller. None: the published parameters, which are
    some mm off for any one arm."""
    upper_registers: bool = False
    """Use the registers from 24 on, where something else has the lower ones (EtherNet/IP, PROFINET,
    another client)."""
    frequency: float = 125.0
    """Packages a second that are asked for."""
    arrival: float = 5e-4
    """No joint may be further from its target once the arm stands, rad."""
    joint_speed: float = 2.09
    """No joint is asked for more, rad/s."""
    tool_speed: float = 1.0
    """The flange is not asked for more, m/s."""
    patience: float = 2.0
    """How long a port may take to answer, s."""
    silence: float = 2.0
    """A link without new data for longer is lost, s."""
    standstill: float = 4.0
    """A move without motion for longer has failed, s."""

    def __post_init__(self) -> None:
        """OptionError names a value that makes no sense."""
        if not self.host.strip():
            raise OptionError(f"host {self.host!r}: expected the controller's address")
        numbers = (
            "frequency", "arrival", "joint_speed", "tool_speed", "patience", "silence", "standstill"
        )  # fmt: skip
        for name in numbers:
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise OptionError(f"{name} {value}: expected a number above 0")


class UrArm:
    """An arm of Universal Robots; see `rig.arms.arm.Arm` for what its methods promise.

    After an `ArmError` that lost the link, `connect` again makes a new one. After a safety stop
    that a person has released, the next move starts the control script anew by itself.
    """

    def __init__(self, options: UrOptions, nominal: DhArm = UR16E) -> None:
        """Read the calibration; nothing is connected. OptionError where it cannot be read."""
        self.options = options
        self.warnings: list[str] = []
        """What somebody should be told, a line each."""
        self.greeting: Greeting | None = None
        """What the controller said of itself when it was reached."""
        if options.calibration is None:
            self._dh = nominal
            self.warnings.append(
                f"{options.host}: no calibration, the published kinematics are used: flange poses"
                " may be some mm off; expected the arm's calibration.conf"
            )
        else:
            self._dh = read_calibration(options.calibration, nominal)
        self._link: Link | None = None
        self._moving = threading.Lock()
        self._halt = threading.Event()
        """Set: the move under way must end."""

    @property
    def dh(self) -> DhArm:
        """See `Arm`."""
        return self._dh

    # Connecting

    def connect(self) -> None:
        """See `Arm`."""
        self._drop()
        options = self.options
        if importlib.util.find_spec("rtde_control") is None:
            raise ArmError(
                "ur-rtde is not installed, expected it beside us: pip install 'depthba[rig]'"
            )
        self.greeting = preflight(options.host, options.patience)
        self._link = Link(options.host)
        try:
            self._ask(
                "connect",
                8.0,
                host=options.host,
                frequency=options.frequency,
                upper_registers=options.upper_registers,
            )
            self.state()
        except Refused as error:
            self._drop()
            raise ArmError(_explained(str(error))) from None
        except BaseException:
            self._drop()
            raise

    def disconnect(self) -> None:
        """See `Arm`."""
        self._halt.set()
        self._drop()

    def _drop(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    # Looking

    def state(self) -> ArmState:
        """See `Arm`: an instant after this call, so that stale data cannot pass for new ones."""
        found = self._instant()
        remote = found["runtime"] == _PLAYING or self._remote()
        return self._state_of(found, remote)

    def _state_of(self, found: dict[str, Any], remote: bool) -> ArmState:
        joints = np.array(found["joints"], float)
        return ArmState(
            stamp=float(found["stamp"]),
            joints=joints,
            velocities=np.array(found["velocities"], float),
            T_base_flange=self._dh.forward(joints),
            safety=_safety_of(found["safety"]),
            remote=remote,
        )

    def _instant(self) -> dict[str, Any]:
        """Wait for the next package; ArmError, and the link is dropped, where none comes."""
        first: float | None = None
        end = time.monotonic() + self.options.silence
        while True:
            found: dict[str, Any] = self._ask("state", self.options.silence)
            if not found["connected"]:
                self._drop()
                raise ArmError(
                    f"{self.options.host}: the controller has closed the connection; expected it"
                    " to stay: connect again once it is back"
                )
            if first is None:
                first = found["stamp"]
            elif found["stamp"] != first:
                return found
            if time.monotonic() > end:
                self._drop()
                raise ArmError(
                    f"{self.options.host}: no new data for {self.options.silence:g} s, expected"
                    f" {self.options.frequency:g} packages a second: connect again once they come"
                )
            time.sleep(_POLL)

    def _remote(self) -> bool:
        return ask_dashboard(self.options.host, self.options.patience).remote

    def _ask(self, do: str, deadline: float, **arguments: Any) -> Any:
        link = self._link
        if link is None:
            raise ArmError(f"{self.options.host}: not connected, expected `connect` before")
        try:
            return link.ask(do, deadline, **arguments)
        except Lost:
            self._drop()
            raise

    # Moving

    def move_joints(self, target: ArrayLike, *, speed: float, acceleration: float) -> ArmState:
        """See `Arm`."""
        host = self.options.host
        joints = checked_joints(target, self._dh, host)
        check_rate("speed", speed, self.options.joint_speed, "rad/s", host)
        check_rate("acceleration", acceleration, np.inf, "rad/s^2", host)
        return self._go("move_joints", lambda q: joints, speed, acceleration)

    def move_linear(self, target: ArrayLike, *, speed: float, acceleration: float) -> ArmState:
        """See `Arm`. The joints at the end are our own; the controller is sent those."""
        host = self.options.host
        T = checked_pose(target, host)
        check_rate("speed", speed, self.options.tool_speed, "m/s", host)
        check_rate("acceleration", acceleration, np.inf, "m/s^2", host)

        def end_of_line(q: Array) -> Array:
            try:
                return straight(self._dh, q, T).joints[-1]
            except OutOfReach as error:
                place = np.round(T[:3, 3], 3).tolist()
                raise ArmError(
                    f"{host}: target at {place} m: {error}; expected a pose that the"
                    " arm reaches in a straight line"
                ) from None

        return self._go("move_line", end_of_line, speed, acceleration)

    def stop(self) -> None:
        """See `Arm`."""
        self._halt.set()
        # A link that is lost has been ended, and the arm braked by it as well as it could be.
        with contextlib.suppress(ArmError):
            self._ask("stop", 2.0)

    def _go(
        self, do: str, end_of: Callable[[Array], Array], speed: float, acceleration: float
    ) -> ArmState:
        """Start a move to the joints that `end_of` gives for the present ones, and watch it."""
        if not self._moving.acquire(blocking=False):
            raise ArmError(f"{self.options.host}: a move is under way, expected it to end before")
        try:
            self._halt.clear()
            target = end_of(self._readied())
            try:
                started = self._ask(
                    do, 3.0, joints=target.tolist(), speed=speed, acceleration=acceleration
                )
                return self._watched(target, started)
            except (Stopped, Lost):
                raise
            except BaseException:
                # Whatever ends the watch, Ctrl-C too, ends the move.
                self.stop()
                raise
        finally:
            self._moving.release()

    def _readied(self) -> Array:
        """Where the arm is (n,), once it may be moved; ArmError where it may not."""
        found = self._instant()
        self._refuse_stop(found)
        if found["mode"] != _RUNNING:
            raise ArmError(
                f"{self.options.host}: robot mode {found['mode']}, expected {_RUNNING} (running):"
                " power the robot on"
            )
        if found["runtime"] != _PLAYING or not found["obeying"]:
            if not self._remote():
                raise ArmError(
                    f"{self.options.host}: the robot is in local mode, expected remote control"
                )
            try:
                self._ask("revive", 6.0)
            except Refused as error:
                raise ArmError(_explained(str(error))) from None
            end = time.monotonic() + 3.0
            while not ((found := self._instant())["obeying"] and found["runtime"] == _PLAYING):
                self._refuse_stop(found)
                if time.monotonic() > end:
                    raise ArmError(
                        f"{self.options.host}: the control script does not start, expected it to"
                        " run within 3 s"
                    )
        return np.array(found["joints"], float)

    def _watched(self, target: Array, started: bool) -> ArmState:
        """Watch a move until the arm stands at its target (n,)."""
        arrived, still_since = 0, time.monotonic()
        while True:
            found = self._instant()
            now = time.monotonic()
            self._refuse_stop(found)
            if self._halt.is_set():
                raise ArmError(f"{self.options.host}: the move was stopped")
            if found["runtime"] != _PLAYING or not started:
                self._explain_end()
            away = np.abs(np.array(found["joints"]) - target)
            still = np.abs(found["velocities"]).max() < _STILL
            if not still:
                still_since = now
            over = still and not found["busy"]
            arrived = arrived + 1 if over and away.max() <= self.options.arrival else 0
            if arrived >= _SAMPLES:
                return self._state_of(found, remote=True)
            waited = now - still_since
            missed = over and not arrived and waited > _SHORT_OF
            if missed or waited > self.options.standstill:
                k = int(np.argmax(away))
                raise ArmError(
                    f"{self.options.host}: the arm stands, {self._dh.joints[k]} {away[k]:.4g} rad"
                    f" from its target, expected at most {self.options.arrival:g}"
                )

    def _refuse_stop(self, found: dict[str, Any]) -> None:
        safety = _safety_of(found["safety"])
        if safety in _KINDS:
            raise _KINDS[safety](
                f"{self.options.host}: {safety.value}; expected a person to look at the robot and"
                " release it"
            )

    def _explain_end(self) -> None:
        """Raise what fits a program that ended by itself."""
        # The safety bits may come a moment after the program's end.
        self._refuse_stop(self._instant())
        greeting = ask_dashboard(self.options.host, self.options.patience)
        refuse_stop(self.options.host, greeting.safety)
        if not greeting.remote:
            raise ArmError(
                f"{self.options.host}: the robot is in local mode, expected remote control"
            )
        raise ArmError(
            f"{self.options.host}: the controller has ended the program, expected it to go on: the"
            " teach pendant says why"
        )


def _safety_of(bits: int) -> Safety:
    for mask, safety in _SAFETY:
        if bits & mask:
            return safety
    return Safety.NORMAL


def _explained(said: str) -> str:
    """What the library says, with what helps."""
    lower = said.lower()
    if "already in use" in lower:
        return (
            f"{said.partition('!')[0]}; expected them free: set upper_registers, or end the other"
            " client (EtherNet/IP, PROFINET)"
        )
    if "remote control" in lower:
        return f"{said}; expected remote control, which the teach pendant switches to"
    return f"{said}; expected the control script to run"
