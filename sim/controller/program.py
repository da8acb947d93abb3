"""What runs on the controller: the client's control script, or a list of moves.

The client's script waits for a number in an input register, does what the number stands for and
answers in output registers; here the same is done without interpreting the script. Of its text two
things count: where its registers begin, and the moves that the client has put into it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from sim.controller.robot import Robot, Runtime, ScriptError, pose_matrix, pose_vector

Array = NDArray[np.float64]

READY, DONE = 1, 2
"""What output register 0 says."""

REALTIME = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
"""Commands after which the script is ready at once: the client takes nothing back."""

_RUNNING = 1 << 15
_UPPER = "24"
"""Where the upper half of the registers begins, which a second client uses."""
_STOP_SCRIPT = 255


@dataclass
class Registers:
    """The general purpose registers of RTDE."""

    in_int: list[int] = field(default_factory=lambda: [0] * 48)
    in_double: list[float] = field(default_factory=lambda: [0.0] * 48)
    out_int: list[int] = field(default_factory=lambda: [0] * 48)
    out_double: list[float] = field(default_factory=lambda: [0.0] * 48)


@dataclass(frozen=True)
class Move:
    """A movej or movel of a script."""

    line: bool
    pose: bool
    """Whether the target is a pose of the tool, not joints."""
    target: tuple[float, ...]
    acceleration: float
    speed: float


_MOVE = re.compile(
    r"\bmove([jlp])\(\s*(p?)\[([^\]]*)\]\s*,\s*a\s*=\s*([-+.\deE]+)\s*,\s*v\s*=\s*([-+.\deE]+)"
)


def moves_in(script: str) -> tuple[Move, ...]:
    """The moves with literal targets in a script, in their order."""
    return tuple(
        Move(
            line=kind != "j",
            pose=bool(pose),
            target=tuple(float(number) for number in numbers.split(",")),
            acceleration=float(a),
            speed=float(v),
        )
        for kind, pose, numbers, a, v in _MOVE.findall(script)
    )


class Program:
    """A running program; `step` is called once in each cycle of the controller."""

    def __init__(self, robot: Robot, registers: Registers, script: str) -> None:
        """`script` is what came over the script port."""
        self.over = False
        self._robot, self._registers = robot, registers
        self._moves = moves_in(script)
        self._controlled = "def rtde_control" in script
        self._int = _offset(script, "reg_offset_int")
        self._double = _offset(script, "reg_offset_float")
        self._executing = False
        self._waiting: Iterator[None] | None = None
        """The rest of a command that takes a while."""
        self._beside: Iterator[None] | None = None
        """A move that goes on while other commands are taken."""
        self._operation = 0
        if self._controlled:
            self._set_int(0, 0)
            self._set_int(2, 0)
        else:
            self._waiting = self._along(self._moves)

    def step(self) -> None:
        """Go on; ScriptError where the program fails."""
        if self._beside is not None and _ended(self._beside):
            self._beside = None
            self._progress(running=False)
        if self._waiting is not None:
            if not _ended(self._waiting):
                return
            self._waiting = None
            if not self._controlled:
                self.over = True
                return
            self._answer(DONE)
        if not self._controlled:
            return
        command = self._registers.in_int[self._int]
        if command in REALTIME:
            self._do(command)
            self._answer(READY)
        elif command == 0:
            self._executing = False
            self._answer(READY)
        elif not self._executing:
            self._executing = True
            if command == _STOP_SCRIPT:
                self.over = True
                return
            self._waiting = self._do(command)
            if self._waiting is None or _ended(self._waiting):
                self._waiting = None
                self._answer(DONE)

    # Registers

    def _doubles(self, first: int, count: int) -> Array:
        at = self._double + first
        return np.array(self._registers.in_double[at : at + count])

    def _set_int(self, index: int, value: int) -> None:
        self._registers.out_int[self._int + index] = value

    def _answer(self, value: int) -> None:
        # A program that a stop has paused says nothing.
        if self._robot.runtime == Runtime.PLAYING:
            self._set_int(0, value)

    def _give(self, values: Array) -> None:
        at = self._double
        self._registers.out_double[at : at + len(values)] = [float(v) for v in values]

    def _progress(self, running: bool) -> None:
        self._set_int(2, self._operation << 24 | (_RUNNING if running else 0))

    # Commands

    def _do(self, command: int) -> Iterator[None] | None:
        """Do a command; what is left of it, if it takes a while."""
        doer = _COMMANDS.get(command)
        if doer is None:
            raise ScriptError(f"command {command} is not simulated")
        return doer(self)

    def _move(self, start: Callable[[], None]) -> Iterator[None] | None:
        return self._go(self._through([start]))

    def _go(self, way: Iterator[None]) -> Iterator[None] | None:
        """Go a way while the client waits, or beside what it commands next."""
        self._beside = None
        if self._registers.in_int[self._int + 1] != 1:
            return way
        self._operation = (self._operation + 1) & 0x7F
        self._progress(running=True)
        self._beside = way
        if _ended(way):
            self._beside = None
            self._progress(running=False)
        return None

    def _through(self, starts: list[Callable[[], None]]) -> Iterator[None]:
        for start in starts:
            start()
            yield from self._until_still()

    def _until_still(self) -> Iterator[None]:
        while self._robot.motion is not None:
            yield

    def _move_joints(self) -> Iterator[None] | None:
        q, (v, a) = self._doubles(0, 6), self._doubles(6, 2)
        return self._move(lambda: self._robot.move_joints(q, v, a))

    def _move_joints_to_pose(self) -> Iterator[None] | None:
        p, (v, a) = self._doubles(0, 6), self._doubles(6, 2)
        robot = self._robot
        return self._move(
            lambda: robot.move_joints(robot.inverse(pose_matrix(p), robot.encoders), v, a)
        )

    def _move_line(self) -> Iterator[None] | None:
        p, (v, a) = self._doubles(0, 6), self._doubles(6, 2)
        return self._move(lambda: self._robot.move_line(pose_matrix(p), v, a))

    def _move_line_to_joints(self) -> Iterator[None] | None:
        q, (v, a) = self._doubles(0, 6), self._doubles(6, 2)
        return self._move(lambda: self._line_to_joints(q, v, a))

    def _line_to_joints(self, q: Array, v: float, a: float) -> None:
        robot = self._robot
        if not np.isfinite(q).all():
            raise ScriptError("movel: the target is not finite")
        robot.move_line(robot.dh.forward(q) @ robot.T_flange_tcp, v, a, joints=q)

    def _path(self) -> Iterator[None] | None:
        return self._go(self._along(self._moves))

    def _along(self, moves: tuple[Move, ...]) -> Iterator[None]:
        for move in moves:
            self._start(move)
            yield from self._until_still()

    def _start(self, move: Move) -> None:
        robot, target, v, a = self._robot, np.array(move.target), move.speed, move.acceleration
        if len(target) != 6:
            raise ScriptError(f"a move to {len(target)} numbers, expected 6")
        if move.line and move.pose:
            robot.move_line(pose_matrix(target), v, a)
        elif move.line:
            self._line_to_joints(target, v, a)
        elif move.pose:
            robot.move_joints(robot.inverse(pose_matrix(target), robot.encoders), v, a)
        else:
            robot.move_joints(target, v, a)

    def _stop(self) -> Iterator[None] | None:
        self._robot.brake(float(self._doubles(0, 1)[0]) or 2.0)
        if self._beside is not None:
            self._beside = None
            self._progress(running=False)
        return self._until_still()

    def _free(self, free: bool) -> None:
        self._robot.free = free

    def _set_tcp(self) -> None:
        self._robot.T_flange_tcp = pose_matrix(self._doubles(0, 6))

    def _protective_stop(self) -> None:
        self._robot.protective_stop("triggered by the program")

    def _inverse(self, near: Array) -> None:
        self._give(self._robot.inverse(pose_matrix(self._doubles(0, 6)), near))

    def _pose_allowed(self) -> None:
        robot, p = self._robot, self._doubles(0, 6)
        try:
            robot.inverse(pose_matrix(p), robot.encoders)
            self._set_int(1, 1)
        except ScriptError:
            self._set_int(1, 0)

    def _joints_allowed(self) -> None:
        q = self._doubles(0, 6)
        self._set_int(1, int(np.isfinite(q).all() and bool(self._robot.dh.within_limits(q))))

    def _pose_product(self) -> None:
        a, b = (pose_matrix(self._doubles(k, 6)) for k in (0, 6))
        self._give(pose_vector(a @ b))

    def _forward(self) -> None:
        T = self._robot.dh.forward(self._doubles(0, 6)) @ pose_matrix(self._doubles(6, 6))
        self._give(pose_vector(T))

    def _steady(self) -> None:
        self._set_int(1, int(self._robot.motion is None))

    def _flange(self) -> None:
        robot = self._robot
        self._give(pose_vector(robot.T_base_tcp @ se3.inverse(robot.T_flange_tcp)))


_COMMANDS: dict[int, Callable[[Program], Iterator[None] | None]] = {
    1: Program._move_joints,
    2: Program._move_joints_to_pose,
    3: Program._move_line,
    4: Program._move_line_to_joints,
    15: lambda p: p._stop(),
    16: lambda p: p._stop(),
    18: lambda p: p._free(True),
    19: lambda p: p._free(False),
    26: lambda p: p._give(np.array([0.002])),
    27: lambda p: p._give(p._robot.encoders),
    29: lambda p: p._set_tcp(),
    30: lambda p: p._inverse(p._doubles(6, 6)),
    31: lambda p: p._protective_stop(),
    33: lambda p: p._stop(),
    34: lambda p: p._stop(),
    36: lambda p: p._pose_allowed(),
    37: lambda p: p._joints_allowed(),
    39: lambda p: p._pose_product(),
    40: lambda p: p._give(pose_vector(p._robot.T_flange_tcp)),
    43: lambda p: p._give(pose_vector(p._robot.T_base_tcp)),
    44: lambda p: p._forward(),
    45: lambda p: p._path(),
    46: lambda p: p._inverse(p._robot.encoders),
    47: lambda p: p._steady(),
    58: lambda p: p._flange(),
}


def _ended(way: Iterator[None]) -> bool:
    """Take a step of it."""
    return next(way, _OVER) is _OVER


_OVER = object()


def _offset(script: str, name: str) -> int:
    """Where the script's registers begin; the client writes a comment before the number."""
    found = re.search(rf"{name}\s*=(?:\s|#[^\n]*\n)*(\d+)", script)
    if found and found[1].lstrip("0") not in ("", _UPPER):
        raise ScriptError(f"{name} {found[1][:20]}, expected 0 or {_UPPER}")
    return int(found[1]) if found else 0
