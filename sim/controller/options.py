"""How a simulated controller is set up, and what can be made to go wrong with it."""

from __future__ import annotations

import ipaddress
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from depthba.errors import OptionError
from depthba.kinematics import UR16E

Fault = Literal[
    "stalled",
    "no-data",
    "slow",
    "blind",
    "local",
    "registers-taken",
    "protective-stop",
    "emergency-stop",
]
FAULTS: tuple[Fault, ...] = get_args(Fault)

CONTROL_PORT = 29990


@dataclass(frozen=True)
class ControllerOptions:
    """A simulated UR16e and its controller."""

    host: str = "127.0.0.2"
    """A loopback address, 127.x.y.z: each controller needs one of its own. On 127.0.0.1 the client
    does not ask whether the robot is in remote control."""
    scene: str | None = None
    """What stands around the arm: a scene as `depthba generate` takes it. None: nothing."""
    seed: int = 0
    """Arrangement of the scene, and the errors of the encoders."""
    speed: float = 1.0
    """Simulated seconds in a second."""
    joints: tuple[float, float, float, float, float, float] = (
        -1.927,
        -1.584,
        1.424,
        -1.41,
        -1.571,
        -0.356,
    )
    """Where the arm stands at the start, rad."""
    calibration: Path | None = None
    """The arm's calibration.conf. None: it is built as published."""
    joint_offset: float = 0.0
    """Standard deviation of each joint's zero, constant, rad: the encoders know nothing of it."""
    version: tuple[int, int, int, int] = (5, 15, 0, 0)
    """Of the controller's software; up to 3.x it streams at 125 Hz, not 500."""
    control_port: int = CONTROL_PORT
    """Where faults are asked for and the truth is told, on the same address."""
    fault: tuple[Fault, ...] = ()
    """What is wrong from the start. stalled: it accepts connections, answers nothing, and the arm
    stands still. no-data: handshakes, but no data. slow: the speed slider at 10 %. blind: the
    simulated camera gets no frames. local: local mode. registers-taken: another client has them."""
    end_with_parent: bool = False
    """End as soon as the process that started it is gone."""

    def __post_init__(self) -> None:
        """OptionError names a value that makes no sense."""
        try:
            address = ipaddress.IPv4Address(self.host)
        except ValueError:
            address = None
        if address is None or not address.is_loopback:
            raise OptionError(
                f"host {self.host}: the simulated controller serves this machine only, expected a"
                " loopback address, 127.0.0.1 to 127.255.255.254"
            )
        if self.seed < 0:
            raise OptionError(f"seed {self.seed}: expected 0 or more")
        if not (math.isfinite(self.speed) and 0.01 <= self.speed <= 100.0):
            raise OptionError(f"speed {self.speed}: expected 0.01 to 100")
        if not UR16E.within_limits(self.joints):
            raise OptionError(f"joints {self.joints}: expected them within the arm's limits, rad")
        if not (math.isfinite(self.joint_offset) and self.joint_offset >= 0.0):
            raise OptionError(f"joint_offset {self.joint_offset}: expected 0 or more, rad")
        if not 1 <= self.control_port <= 65535:
            raise OptionError(f"control_port {self.control_port}: expected 1 to 65535")
        for fault in self.fault:
            if fault not in FAULTS:
                raise OptionError(f"fault {fault!r}: choose from: {', '.join(FAULTS)}")
