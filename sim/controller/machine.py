"""The controller behind its ports: robot, registers, the running program, and what is wrong."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from depthba.kinematics import UR16E
from depthba.straight import straight
from depthba.ur_calibration import read_calibration
from sim.controller.options import FAULTS, ControllerOptions
from sim.controller.program import Program, Registers
from sim.controller.protocol import Value
from sim.controller.robot import (
    SAFETY_BITS,
    Robot,
    RobotMode,
    Runtime,
    ScriptError,
)
from sim.controller.surroundings import Surroundings
from sim.seeds import stream

_SLOW = 0.1
_OUT_INT, _OUT_DOUBLE = (
    tuple(f"output_{kind}_register_{k}" for k in range(48)) for kind in ("int", "double")
)
_JOINT_RUNNING = 253
_POWERED, _PROGRAM = 1 << 0, 1 << 1
"""Of RTDE's robot_status_bits."""


class Machine:
    """Everything of a controller but its sockets."""

    def __init__(self, options: ControllerOptions) -> None:
        """Build the scene; SimulationError or OptionError says what is wrong with the options."""
        self.options = options
        dh = UR16E
        if options.calibration is not None:
            dh = read_calibration(options.calibration, dh)
        surroundings = Surroundings.of_scene(options.scene, options.seed, dh)
        rng = stream(options.seed, "controller", "zeros")
        zeros = options.joint_offset * rng.standard_normal(len(dh.joints))
        self.robot = Robot(dh, surroundings, np.array(options.joints, float), zeros)
        # What is compiled at the first call must not hold up the first move.
        straight(dh, self.robot.encoders, self.robot.T_base_tcp)
        self.registers = Registers()
        self.program: Program | None = None
        self.faults: set[str] = set()
        for fault in options.fault:
            self.set_fault(fault, True)

    def advance(self, dt: float) -> None:
        """Let `dt` s of simulated time pass."""
        robot = self.robot
        robot.advance(dt)
        if self.program is None:
            return
        if robot.runtime != Runtime.PLAYING:
            self.program = None
            return
        try:
            self.program.step()
        except (ScriptError, ValueError, ArithmeticError, LookupError) as error:
            # whatever a program asks for ends that program, not the controller
            robot.notes.append(f"the program ended: {error}")
            self.program.over = True
        if self.program.over:
            robot.halt_program()
            self.program = None

    def take_script(self, script: str) -> None:
        """Run a program in place of the one before; ignored where none may run."""
        robot = self.robot
        if not robot.obeys:
            return
        robot.halt_program()
        try:
            self.program = Program(robot, self.registers, script)
        except (ScriptError, ValueError) as error:
            robot.notes.append(f"a program was refused: {error}")
            return
        robot.runtime = Runtime.PLAYING

    def take_inputs(self, values: Mapping[str, float]) -> None:
        """Set input registers by their RTDE names."""
        for name, value in values.items():
            kind, _, index = name.removeprefix("input_").partition("_register_")
            if kind == "int":
                self.registers.in_int[int(index)] = int(value)
            elif kind == "double":
                self.registers.in_double[int(index)] = float(value)

    @property
    def taken(self) -> frozenset[str]:
        """The input registers that another client holds: the lower ones, if any."""
        if "registers-taken" not in self.faults:
            return frozenset()
        return frozenset(
            f"input_{kind}_register_{k}" for kind in ("int", "double") for k in range(24)
        )

    def variables(self) -> dict[str, Value]:
        """RTDE's variables; what is left out is 0."""
        robot, registers = self.robot, self.registers
        q, qd = robot.encoders.tolist(), robot.velocities.tolist()
        pose = robot.tcp
        powered = robot.robot_mode == RobotMode.RUNNING
        playing = robot.runtime == Runtime.PLAYING
        values: dict[str, Value] = {
            "timestamp": robot.time,
            "actual_q": q,
            "target_q": q,
            "actual_qd": qd,
            "target_qd": qd,
            "actual_TCP_pose": pose,
            "target_TCP_pose": pose,
            "robot_mode": int(robot.robot_mode),
            "safety_mode": int(robot.safety),
            "joint_mode": [_JOINT_RUNNING] * 6,
            "runtime_state": int(robot.runtime),
            "safety_status_bits": SAFETY_BITS[robot.safety],
            "robot_status_bits": (_POWERED if powered else 0) | (_PROGRAM if playing else 0),
            "speed_scaling": robot.slider,
            "target_speed_fraction": robot.slider,
        }
        values.update(zip(_OUT_INT, registers.out_int, strict=True))
        values.update(zip(_OUT_DOUBLE, registers.out_double, strict=True))
        return values

    # What the control channel asks for

    def set_fault(self, name: str, on: bool) -> None:
        """Let something go wrong, or right again; ValueError lists what there is."""
        if name not in FAULTS:
            raise ValueError(f"fault {name!r}: choose from: {', '.join(FAULTS)}")
        robot = self.robot
        (self.faults.add if on else self.faults.discard)(name)
        if name == "slow":
            robot.slider = _SLOW if on else 1.0
        elif name == "local":
            robot.remote = not on
            robot.halt_program()
        elif name == "protective-stop" and on:
            robot.protective_stop("asked for")
        elif name == "emergency-stop" and on:
            robot.emergency_stop()
        elif name in ("protective-stop", "emergency-stop"):
            robot.release()

    def truth(self) -> dict[str, Any]:
        """This instant as nobody but the simulation knows it: m, rad, s of simulated time."""
        robot = self.robot
        joints = robot.joints
        T = robot.surroundings.T_world_base @ robot.dh.forward(joints)
        return {
            "time": robot.time,
            "joints": joints.tolist(),
            "T_world_flange": T.tolist(),
            "encoders": robot.encoders.tolist(),
            "moving": robot.motion is not None,
            "safety": robot.safety.name,
            "runtime": robot.runtime.name,
            "remote": robot.remote,
        }

    def about(self) -> dict[str, Any]:
        """What is simulated."""
        return {
            "scene": self.options.scene,
            "seed": self.options.seed,
            "speed": self.options.speed,
            "pid": os.getpid(),
            "joint_names": list(self.robot.dh.joints),
            "faults": sorted(self.faults),
        }

    def obey(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Do what a request of the control channel says; ValueError: it makes no sense."""
        do = request.get("do")
        if do not in _REQUESTS:
            raise ValueError(f"do {do!r}: choose from: {', '.join(_REQUESTS)}, drop, refuse, kill")
        return _REQUESTS[do](self, request)

    def _fault(self, request: Mapping[str, Any]) -> dict[str, Any]:
        self.set_fault(str(request.get("name")), bool(request.get("on", True)))
        return {}

    def _place(self, request: Mapping[str, Any]) -> dict[str, Any]:
        self.robot.place(request.get("joints", ()))
        return {}


_REQUESTS: dict[str, Callable[[Machine, Mapping[str, Any]], dict[str, Any]]] = {
    "about": lambda machine, request: machine.about(),
    "truth": lambda machine, request: machine.truth(),
    "expose": lambda machine, request: machine.truth(),
    "fault": Machine._fault,
    "place": Machine._place,
}
