"""A gantry behind Modbus TCP, on pymodbus."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba.errors import MissingPackage
from rig.axes.axes import AxesState, Axis
from rig.axes.modbus_map import RegisterMap
from rig.axes.watching import Patience, WatchedAxes, braked_on_failure
from rig.errors import AxesError

Array = NDArray[np.float64]

_SEQUENCES = 65535


@dataclass(frozen=True)
class ModbusOptions:
    """How to reach a gantry over Modbus TCP, and what it may do."""

    host: str
    axes: tuple[Axis, ...]
    """Names, soft limits and speeds, in the order of the map's registers."""
    port: int = 502
    unit: int = 1
    """The device's id behind that address."""
    metres_per_count: float = 1e-6
    """Of positions, targets and speeds."""
    registers: RegisterMap = field(default_factory=RegisterMap)
    connect_timeout: float = 2.0
    """For the connection to come up, s."""
    reply_timeout: float = 1.0
    """For the answer to a request, and for a command to be taken, s."""
    home_timeout: float = 60.0
    """For the axes to find their switches, s."""
    patience: Patience = field(default_factory=Patience)


class ModbusGantry(WatchedAxes):
    """`rig.axes.axes.Axes` on a controller with the registers of `RegisterMap`.

    The stamp of a state is the host's clock when its answer arrived. Threads may share one: a
    request holds a lock for its answer, and `stop` needs no more than that.
    """

    def __init__(self, options: ModbusOptions):
        super().__init__(options.axes, options.patience, f"gantry {options.host}:{options.port}")
        options.registers.check(len(options.axes))
        self._options = options
        self._client: Any = None
        self._sequence = 0
        self._lock = threading.RLock()

    def connect(self) -> None:
        """Reach the controller, and see that it answers. AxesError in time whatever is there."""
        try:
            from pymodbus.client import ModbusTcpClient
        except ImportError as error:
            raise MissingPackage(
                "a Modbus gantry needs the package pymodbus: pip install 'depthba[rig]'"
            ) from error
        # it reports every failure on its own as well, and the caller gets one line
        logging.getLogger("pymodbus").addHandler(logging.NullHandler())
        self.disconnect()
        options = self._options
        client = ModbusTcpClient(
            options.host, port=options.port, timeout=options.reply_timeout, retries=0
        )
        # its own connect() keeps the reason of a failure to itself
        client.socket = self._connected()
        with self._lock:
            self._client = client
            # the controller may remember a number from an earlier client
            self._sequence = self._registers()[options.registers.acknowledged]

    def home(self) -> AxesState:
        """Find the reference switches. An alarm whose cause is gone is cleared first."""
        before = self._stops
        if self.status().alarm is not None:
            self._command(self._options.registers.commands.reset)
        deadline = time.monotonic() + self._options.home_timeout
        with braked_on_failure(self.stop):
            self._command(self._options.registers.commands.home, unless=before)
            while True:
                state = self.status()
                self._refuse_stopped(before, "while homing")
                if state.alarm is not None:
                    raise AxesError(f"{self._who}: alarm while homing: {state.alarm}")
                if state.homed and not state.moving:
                    return state
                if time.monotonic() > deadline:
                    raise AxesError(
                        f"{self._who}: not homed within {self._options.home_timeout:g} s"
                    )
                time.sleep(self._options.patience.poll)

    def status(self) -> AxesState:
        """The newest instant."""
        found = self._registers()
        map_ = self._options.registers
        word = found[map_.status]
        alarm = bool(word >> map_.bits.alarm & 1) or found[map_.alarm] != 0
        counts = [self._joined(found[at], found[at + 1]) for at in map_.positions]
        return AxesState(
            stamp=time.time(),
            position=np.array(counts) * self._options.metres_per_count,
            homed=bool(word >> map_.bits.homed & 1),
            moving=bool(word >> map_.bits.moving & 1),
            alarm=map_.alarm_words(found[map_.alarm]) if alarm else None,
        )

    def stop(self) -> None:
        """Brake now, and end the move that is under way in another thread. Never raises."""
        self._stops += 1
        with suppress(AxesError):  # the link is gone: the move in the other thread says so
            self._send(self._options.registers.commands.stop, [])

    def disconnect(self) -> None:
        """Let go of the controller. Safe to call twice, and after a failure."""
        with self._lock:
            client, self._client = self._client, None
            if client is not None:
                client.close()

    def _start(self, position: Array, speed: float, before: int) -> None:
        map_ = self._options.registers
        operands = [(map_.speed, max(1, self._counts(speed)))]
        operands += [(at, self._counts(p)) for at, p in zip(map_.targets, position, strict=True)]
        self._command(map_.commands.move, operands, unless=before)

    def _connected(self) -> socket.socket:
        options = self._options
        try:
            return socket.create_connection((options.host, options.port), options.connect_timeout)
        except TimeoutError as error:
            reason: object = f"nobody answers within {options.connect_timeout:g} s"
            cause: OSError = error
        except ConnectionRefusedError as error:
            reason, cause = "the connection is refused", error
        except OSError as error:
            reason, cause = f"no connection: {error.strerror or error}", error
        raise AxesError(f"{self._who}: {reason}, expected a Modbus TCP controller there") from cause

    def _command(
        self, code: int, operands: list[tuple[int, int]] | None = None, unless: int | None = None
    ) -> None:
        """Send a command, unless a stop came since, and wait until the controller takes it."""
        with self._lock:  # a stop cannot come between the check and the command
            if unless is not None:
                self._refuse_stopped(unless, "before the move began")
            sequence = self._send(code, operands or [])
        deadline = time.monotonic() + self._options.reply_timeout
        while (taken := self._registers()[self._options.registers.acknowledged]) != sequence:
            if self._sequence != sequence:
                return  # a stop of another thread overtook it: the watch sees that
            if time.monotonic() > deadline:
                raise AxesError(
                    f"{self._who}: command {code} was not taken within"
                    f" {self._options.reply_timeout:g} s: acknowledged {taken}, expected {sequence}"
                )
            time.sleep(self._options.patience.poll)

    def _send(self, code: int, operands: list[tuple[int, int]]) -> int:
        """Write a command; return its sequence number."""
        map_ = self._options.registers
        with self._lock:
            for address, value in operands:
                self._write(address, self._words(value))
            self._sequence = self._sequence % _SEQUENCES + 1
            if map_.sequence == map_.command + 1:
                self._write(map_.command, [code, self._sequence])
            else:
                self._write(map_.command, [code])
                self._write(map_.sequence, [self._sequence])
            return self._sequence

    def _registers(self) -> dict[int, int]:
        """Return the status registers by their address."""
        map_ = self._options.registers
        first, count = map_.status_span()

        def read(client: Any) -> Any:
            ask = client.read_input_registers
            if map_.status_table == "holding":
                ask = client.read_holding_registers
            return ask(first, count=count, device_id=self._options.unit)

        found = self._asked(read, f"registers {first} to {first + count - 1}").registers
        if len(found) != count:
            raise AxesError(f"{self._who}: {len(found)} registers came, expected {count}")
        return dict(enumerate(found, start=first))

    def _write(self, address: int, words: list[int]) -> None:
        self._asked(
            lambda client: client.write_registers(address, words, device_id=self._options.unit),
            f"register {address}",
        )

    def _asked(self, request: Callable[[Any], Any], what: str) -> Any:
        """Return the answer to a request; AxesError, and no link any more, where there is none."""
        from pymodbus.exceptions import ConnectionException, ModbusException

        with self._lock:
            if self._client is None:
                raise AxesError(f"{self._who}: not connected, expected connect() first")
            try:
                answer = request(self._client)
            except (ConnectionException, OSError) as error:
                self.disconnect()
                raise AxesError(f"{self._who}: the connection was lost") from error
            except ModbusException as error:
                # a late answer would be taken for that to the next request
                self.disconnect()
                raise AxesError(
                    f"{self._who}: no answer for {what} within {self._options.reply_timeout:g} s"
                ) from error
        if answer.isError():
            code = getattr(answer, "exception_code", "unknown")
            raise AxesError(
                f"{self._who}: refuses {what} with Modbus exception {code};"
                " expected the registers of the map"
            )
        return answer

    def _counts(self, metres: float) -> int:
        counts = round(metres / self._options.metres_per_count)
        if not -(2**31) <= counts < 2**31:
            raise AxesError(
                f"{self._who}: {metres:g} is {counts} counts, expected a number of 32 bit"
            )
        return counts

    def _words(self, value: int) -> list[int]:
        words = [value >> 16 & 0xFFFF, value & 0xFFFF]
        return words if self._options.registers.word_order == "big" else words[::-1]

    def _joined(self, first: int, second: int) -> int:
        high, low = (first, second)
        if self._options.registers.word_order == "little":
            high, low = second, first
        value = high << 16 | low
        return value - (1 << 32) if value >= 1 << 31 else value
