"""A simulated gantry behind Modbus TCP, on pymodbus' own server.

Run as a process of its own: ``python -m sim.axes.modbus_device --host 127.0.0.9 --port 5020``. It
prints one line, ``listening on HOST:PORT``, once a client may come, and serves until it is ended.

Registers (two axes; numbers of two registers have the high word first; 1 count is 1 micrometre):

======= ============================================================
holding 0 command (1 home, 2 move, 3 stop, 4 reset), 1 sequence number,
        2-3 speed, 4-5 and 6-7 targets
input   0 status (bit 0 homed, 1 moving, 2 alarm), 1 alarm code,
        2 last sequence number taken, 4-5 and 6-7 positions
======= ============================================================
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from depthba.errors import MissingPackage, OptionError
from sim.axes.carriage import Carriage, Doing, Mechanics
from sim.axes.serving import check_loopback, end_abruptly, end_with_parent
from sim.axes.stage import Stage, tell

METRES_PER_COUNT = 1e-6
HOME, MOVE, STOP, RESET = 1, 2, 3, 4
LIMIT_SWITCH, WATCHDOG, NOT_HOMED, OUTSIDE, NO_SWITCH = 2, 4, 5, 6, 7
_HOLDING, _INPUT = (3, 6, 16), 4
_SEQUENCE, _SPEED, _OPERANDS = 1, 2, 4


@dataclass(frozen=True)
class Options:
    """A simulated gantry behind Modbus TCP; ends when it is killed."""

    host: str = "127.0.0.9"
    """Loopback address to listen on; no other is served."""
    port: int = 5020
    """0: one that is free."""
    unit: int = 1
    """Id that it answers to."""
    watchdog: float = 1.0
    """The axes brake, and an alarm comes up, when no request arrived for so long in a move, s."""
    rate: float = 1.0
    """How many times faster than real its time runs."""
    mechanics: Mechanics = field(default_factory=Mechanics)
    stage: Stage = field(default_factory=Stage)
    """What stands around it."""
    end_with_parent: bool = False
    """End as soon as the process that started it is gone."""


class ModbusDevice:
    """The controller's program: registers in, motion out. `now` is on the device's own clock, s."""

    def __init__(self, options: Options):
        self.options = options
        self.carriage = Carriage(options.mechanics)
        self.axes = len(options.mechanics.upper)
        self.holding = [0] * (_OPERANDS + 2 * self.axes)
        self._taken = 0
        self._alarm = 0
        self._asked = -np.inf

    def write(self, address: int, values: list[int], now: float) -> None:
        """Take what a client wrote; a new sequence number starts the command."""
        self._look(now)
        self.holding[address : address + len(values)] = values
        if self.holding[_SEQUENCE] != self._taken:
            self._taken = self.holding[_SEQUENCE]
            self._obey(self.holding[0], now)

    def read(self, now: float) -> list[int]:
        """Return the input registers."""
        self._look(now)
        doing = self.carriage.doing(now)
        status = self.carriage.homed | (doing is not Doing.STANDING) << 1 | (self._alarm != 0) << 2
        words = [int(status), self._alarm, self._taken, 0]
        for count in np.rint(self.carriage.position(now) / METRES_PER_COUNT).astype(int):
            words += [int(count) >> 16 & 0xFFFF, int(count) & 0xFFFF]
        return words

    def _look(self, now: float) -> None:
        """Let the axes move on, and see whether the client or the axes have failed since."""
        lost = self._asked + self.options.watchdog * self.options.rate
        if now > lost and self.carriage.doing(lost) is Doing.MOVING:
            self.carriage.brake(lost)
            self._alarm = WATCHDOG
        self._asked = now
        self.carriage.doing(now)
        if self.carriage.alarm is not None:
            self._alarm = LIMIT_SWITCH if self.carriage.alarm == "limit" else NO_SWITCH

    def _obey(self, command: int, now: float) -> None:
        if command == STOP:
            self.carriage.brake(now)
        elif command == RESET:
            self._alarm, self.carriage.alarm = 0, None
        elif self._alarm or self.carriage.doing(now) is not Doing.STANDING:
            return  # as a real one: only what stands, without an alarm, takes more
        elif command == HOME:
            self.carriage.home(now)
        elif command == MOVE:
            self._move(now)

    def _move(self, now: float) -> None:
        numbers = [
            int(np.int32(np.uint32(high << 16 | low)))
            for high, low in zip(
                self.holding[_SPEED::2], self.holding[_SPEED + 1 :: 2], strict=True
            )
        ]
        speed, target = numbers[0] * METRES_PER_COUNT, np.array(numbers[1:]) * METRES_PER_COUNT
        m = self.options.mechanics
        if not self.carriage.homed:
            self._alarm = NOT_HOMED
        elif np.any(target < m.lower) or np.any(target > m.upper) or speed <= 0:
            self._alarm = OUTSIDE
        else:
            self.carriage.move(target, speed, now)


async def serve(options: Options) -> None:
    """Serve until cancelled; says where it listens. Raises OptionError for what is no loopback."""
    try:
        from pymodbus.constants import ExcCodes
        from pymodbus.server import ModbusTcpServer
        from pymodbus.simulator import DataType, SimData, SimDevice
    except ImportError as error:
        raise MissingPackage(
            "the simulated Modbus gantry needs the package pymodbus: pip install 'depthba[rig]'"
        ) from error
    check_loopback(options.host)
    device = ModbusDevice(options)
    tell(options.stage, lambda: device.carriage.glimpse(options.rate * time.monotonic()))
    if options.end_with_parent:
        end_with_parent()

    async def action(
        function: int, start: int, address: int, count: int, registers: list, values: list | None
    ) -> ExcCodes | None:
        now = options.rate * time.monotonic()
        if function == _INPUT:
            found = device.read(now)
            registers[: len(found)] = found
        elif function in _HOLDING and values is not None:
            device.write(address, [int(v) for v in values], now)
        fault = device.carriage.fault
        if fault == "drop":
            end_abruptly()
        if fault == "silent":
            await asyncio.Event().wait()
        return None

    def block(count: int) -> list:
        return [SimData(0, count=count, values=0, datatype=DataType.REGISTERS)]

    bits = [SimData(0, count=16, values=False, datatype=DataType.BITS)]
    registers = len(device.holding)
    simulated = SimDevice(
        options.unit, simdata=(bits, bits, block(registers), block(registers)), action=action
    )
    server: Any = ModbusTcpServer(simulated, address=(options.host, options.port))
    try:
        await server.serve_forever(background=True)
    except (RuntimeError, OSError) as error:
        raise OptionError(f"{options.host}:{options.port}: cannot listen: {error}") from error
    host, port = server.transport.sockets[0].getsockname()
    print(f"listening on {host}:{port}", flush=True)
    await server.serving


def main() -> None:
    """Serve until the process is ended."""
    from sim.axes.serving import run

    run(Options, lambda options: asyncio.run(serve(options)))


if __name__ == "__main__":
    main()
