"""A gantry behind a GRBL 1.1 controller: G-code over a serial port, on pyserial.

Targets are sent in the machine's own frame (G53), so that no work offset that somebody left in the
controller can shift them. GRBL does not tell whether it was homed: only what this object homed,
since it connected and with no alarm after, counts.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rig.axes.axes import AxesState, Axis
from rig.axes.grbl_words import (
    HOMING,
    Report,
    alarm_words,
    code_of,
    error_words,
    homing_time,
    parse_report,
)
from rig.axes.serial_link import SerialLink
from rig.axes.watching import Patience, WatchedAxes
from rig.errors import AxesError

Array = NDArray[np.float64]

_LETTERS = "xyz"
_RESET, _HOLD, _REPORT = b"\x18", b"!", b"?"
_QUIET = 0.1
"""A greeting has ended when nothing more came for so long, s."""
_BRAKING = 3.0
"""A feed hold that has not come to rest after so long is cut off by a reset, s."""


@dataclass(frozen=True)
class GrblOptions:
    """How to reach a GRBL 1.1 controller, and what it may do."""

    port: str
    """Of the serial device, as /dev/ttyUSB0."""
    axes: tuple[Axis, ...]
    """Named x, y or z, as the controller's."""
    origin: tuple[float, ...] | None = None
    """Where position 0 of each axis lies in the machine's frame, m. None: at the machine's own 0;
    mind that GRBL's frame is negative by default."""
    baud: int = 115200
    connect_timeout: float = 3.0
    """For the greeting; a board that restarts when its port is opened needs two seconds."""
    reply_timeout: float = 1.0
    """For the answer to a line or a report, s."""
    home_timeout: float | None = None
    """For `$H`, s. The controller says nothing meanwhile, so this is what ends it where it hangs.
    None: reckoned from the controller's travel ($130 to $132) and homing speeds ($24, $25)."""
    patience: Patience = field(default_factory=Patience)


class GrblGantry(WatchedAxes):
    """`rig.axes.axes.Axes` on a GRBL 1.1 controller with homing ($22=1).

    The stamp of a state is the host's clock when its report arrived. Threads may share one; `stop`
    waits for nobody, `status` for an answer, or until homing has ended.
    """

    def __init__(self, options: GrblOptions):
        super().__init__(options.axes, options.patience, f"gantry {options.port}")
        names = [axis.name for axis in options.axes]
        if set(names) - set(_LETTERS):
            raise AxesError(f"axes {', '.join(names)}, expected some of x, y, z")
        if options.origin is not None and len(options.origin) != len(names):
            raise AxesError(f"origin of {len(options.origin)} numbers, expected {len(names)}")
        self._options = options
        self._rows = [_LETTERS.index(name) for name in names]
        self._origin = np.array(options.origin or [0.0] * len(names))
        self._link: SerialLink | None = None
        self._lock = threading.RLock()
        self._homed = False
        self._homing = False
        self._home_timeout = HOMING
        self._held = False
        self._alarm: int | None = None
        self._offset: Array = np.zeros(3)

    def connect(self) -> None:
        """Reset the controller, read its greeting and settings. It moves nothing.

        AxesError where there is no port, no GRBL 1.1, no homing, or where it reports inches.
        """
        self.disconnect()
        with self._lock:
            self._link = SerialLink(self._options.port, self._options.baud, self._who)
            try:
                self._reset()
                settings = self._settings()
                self._home_timeout = self._options.home_timeout or homing_time(settings)
            except AxesError:
                self.disconnect()
                raise
            for name, expected, meaning in (
                ("$22", "1", "homing enabled"),
                ("$13", "0", "reports in millimetres"),
            ):
                found = settings.get(name)
                if found != expected:
                    self.disconnect()
                    raise AxesError(
                        f"{self._who}: setting {name} is {found}, expected {expected}: {meaning}"
                    )

    def home(self) -> AxesState:
        """Find the reference switches: `$H`. An alarm is cleared by a reset first."""
        before = self._stops
        with self._lock:
            self._homed = False
            if self._held or self._alarm is not None:
                self._reset()
            self._homing = True
            try:
                self._refuse_stopped(before, "before homing")
                self._line("$H", self._home_timeout)
            except BaseException as error:
                self._end_motion()
                if isinstance(error, AxesError) and self._stops != before:
                    raise AxesError(f"{self._who}: stopped on request while homing") from error
                raise
            finally:
                self._homing = False
            self._homed, self._alarm = True, None
            return self.status()

    def status(self) -> AxesState:
        """The newest instant."""
        report = self._report()
        stamp = time.time()
        machine = report.machine
        if machine is None and report.work is not None:
            machine = report.work + self._offset[: len(report.work)]
        if machine is None or len(machine) <= max(self._rows):
            raise AxesError(f"{self._who}: a report without the axes' places")
        alarm = report.blocked
        if report.state == "Alarm":
            self._homed = False
            alarm = alarm_words(self._alarm)
        return AxesState(
            stamp=stamp,
            position=machine[self._rows] / 1e3 - self._origin,
            homed=self._homed,
            moving=report.moving,
            alarm=alarm,
        )

    def stop(self) -> None:
        """Brake now, and end the move that is under way in another thread. Never raises.

        A feed hold, which keeps the position; homing knows none and is reset, as GRBL wants it.
        """
        self._stops += 1
        link = self._link
        if link is None:
            return
        self._held = True
        with suppress(AxesError):  # the link is gone: the move in the other thread says so
            link.send(_RESET if self._homing else _HOLD)

    def disconnect(self) -> None:
        """Let go of the port. Safe to call twice, and after a failure."""
        with self._lock:
            link, self._link = self._link, None
            self._homed = self._held = False
            self._alarm = None
            if link is not None:
                link.close()

    def _awake(self) -> AxesState:
        with self._lock:
            if self._held:
                self._reset()
            return self.status()

    def _start(self, position: Array, speed: float, before: int) -> None:
        places = "".join(
            f"{axis.name.upper()}{1e3 * value:.3f}"
            for axis, value in zip(self.axes, position + self._origin, strict=True)
        )
        with self._lock:
            self._refuse_stopped(before, "before the move began")
            # mm, absolute, per minute, in the machine's frame
            self._line(f"G21G90G94G53G1{places}F{60e3 * speed:.1f}", self._options.reply_timeout)

    def _open(self) -> SerialLink:
        if self._link is None:
            raise AxesError(f"{self._who}: not connected, expected connect() first")
        return self._link

    def _end_motion(self) -> None:
        """Drop what is left of a move, once a feed hold has brought it to rest, or of homing."""
        deadline = time.monotonic() + _BRAKING
        try:
            while not self._homing and self._report().moving and time.monotonic() < deadline:
                time.sleep(self._options.patience.poll)
            self._reset()
        except AxesError:
            pass  # the error that led here is the one to tell

    def _reset(self) -> None:
        """Soft reset, and the greeting that follows it."""
        with self._lock:
            link = self._open()
            link.drain()
            link.send(_RESET)
            deadline = time.monotonic() + self._options.connect_timeout
            self._held = False
            while (line := link.line(deadline)) is not None:
                self._note_alarm(line)
                if line.startswith("Grbl"):
                    if not line.startswith("Grbl 1.1"):
                        self.disconnect()
                        raise AxesError(f"{self._who}: greets with {line!r}, expected Grbl 1.1")
                    # a board that was just powered up greets twice
                    while (line := link.line(time.monotonic() + _QUIET)) is not None:
                        self._note_alarm(line)
                    return
            self.disconnect()
            raise AxesError(
                f"{self._who}: no greeting within {self._options.connect_timeout:g} s,"
                " expected a GRBL 1.1 controller there"
            )

    def _settings(self) -> dict[str, str]:
        """Return the controller's settings, as {"$22": "1"}."""
        lines = self._line("$$", self._options.reply_timeout)
        pairs = [line.partition("=") for line in lines if line.startswith("$")]
        return {name: value.split(" ")[0] for name, _, value in pairs}

    def _line(self, text: str, timeout: float) -> list[str]:
        """Send a line; return what was said before its ok. AxesError for error:n and ALARM:n."""
        said: list[str] = []
        with self._lock:
            link = self._open()
            self._tell(link, text.encode("ascii") + b"\n")
            deadline = time.monotonic() + timeout
            while (line := self._heard(link, deadline)) is not None:
                if line == "ok":
                    return said
                if (code := code_of(line, "error")) is not None:
                    raise AxesError(f"{self._who}: refuses {text!r}: {error_words(code)}")
                if self._note_alarm(line):
                    raise AxesError(f"{self._who}: alarm: {alarm_words(self._alarm)}")
                said.append(line)
            why = f"no answer to {text!r} within {timeout:.3g} s"
            if self._homing:
                with suppress(AxesError):  # the link is gone as well, and there is more to tell
                    link.send(_RESET)
                why = (
                    f"homing says nothing for {timeout:.3g} s, longer than its travel and speed"
                    " allow, and was stopped; expected the switches to be found: see to them and"
                    " to the axes, or set home_timeout"
                )
            self.disconnect()
            raise AxesError(f"{self._who}: {why}")

    def _report(self) -> Report:
        with self._lock:
            link = self._open()
            self._tell(link, _REPORT)
            deadline = time.monotonic() + self._options.reply_timeout
            while (line := self._heard(link, deadline)) is not None:
                self._note_alarm(line)
                report = parse_report(line)
                if report is not None:
                    if report.offset is not None:
                        self._offset = report.offset
                    return report
            self.disconnect()
            raise AxesError(
                f"{self._who}: no status report within {self._options.reply_timeout:g} s"
            )

    def _tell(self, link: SerialLink, data: bytes) -> None:
        """Write; a lost link is closed."""
        try:
            link.send(data)
        except AxesError:
            self.disconnect()
            raise

    def _heard(self, link: SerialLink, deadline: float) -> str | None:
        """Return the next line; a lost link is closed, a restart of the controller is an error."""
        try:
            line = link.line(deadline)
        except AxesError:
            self.disconnect()
            raise
        if line is not None and line.startswith("Grbl"):
            self._homed = False
            raise AxesError(f"{self._who}: the controller restarted; home the axes again")
        return line

    def _note_alarm(self, line: str) -> bool:
        code = code_of(line, "ALARM")
        if code is None:
            return False
        self._alarm, self._homed = code, False
        return True
