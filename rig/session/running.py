"""The session itself: from station to station, frame by frame, so that nothing is lost."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba.dataset import DatasetWriter
from depthba.errors import DepthbaError
from rig.cameras.camera import CameraInfo, Capture, DepthCamera
from rig.cameras.checking import check
from rig.errors import CameraError, CameraTimeout, RigError, Stopped
from rig.session.carriers import Carrier, Standing, await_still
from rig.session.interrupts import Interrupts
from rig.session.options import Session
from rig.session.planning import Plan
from rig.session.record import Skipped, note_skipped, progress
from rig.session.steady import SteadyClock
from rig.session.workspace import Workspace

Array = NDArray[np.float64]


class SessionEnded(RigError):
    """A session came to an end before its last station; the same command goes on with it."""


def _nobody(question: str) -> bool:
    return False


@dataclass(frozen=True)
class Listeners:
    """Who is told what goes on, and asked."""

    say: Callable[[str, int, int], None] = lambda text, done, total: None
    """What is being done, and how many of all stations are."""
    ask: Callable[[str], bool] = _nobody
    """Whether to go on after a stop; asked while the rig stands."""
    moved: Callable[[Array, float], None] = lambda T_world_camera, stamp: None
    """The camera stands at a pose (4, 4), as believed, at a time of the host's clock."""
    committed: Callable[[int], None] = lambda frame: None
    """A frame of that id is in the dataset."""


@dataclass(frozen=True)
class Summary:
    """How a session went."""

    path: Path
    stations: int
    frames: int
    """In the dataset, those of earlier runs too."""
    taken: int
    """By this run."""
    skipped: tuple[Skipped, ...]
    left_out: tuple[tuple[str, str], ...]
    """Label and reason of poses that the plan could not hold."""
    retries: int
    """Frames that were tried for again."""
    stops: int
    """Safety stops after which it went on."""
    seconds: float

    @property
    def complete(self) -> bool:
        """Whether every pose that was asked for has its frame."""
        return not self.skipped and not self.left_out


@dataclass
class Run:
    """One run of a session. Everything is connected and opened, and the dataset begun."""

    session: Session
    space: Workspace
    plan: Plan
    carrier: Carrier
    camera: DepthCamera
    info: CameraInfo
    writer: DatasetWriter
    listeners: Listeners = field(default_factory=Listeners)
    again: bool = False
    """Try the stations that an earlier run skipped once more, at the end."""
    interrupts: Interrupts = field(default_factory=Interrupts)
    """Who hears Ctrl-C."""
    _clock: SteadyClock = field(init=False)
    _before: Capture | None = None
    _retries: int = 0
    _stops: int = 0

    def __post_init__(self) -> None:
        """Set the session's clock."""
        self._clock = SteadyClock(self.writer.stamps)

    def __call__(self) -> Summary:
        """Go to every station that has no frame yet.

        Raises:
            SessionEnded: what ended it, and that the same command goes on.
            KeyboardInterrupt: by the user; the rig is braked, the dataset whole.
        """
        with self.interrupts.heard():
            return self._all()

    def _all(self) -> Summary:
        begin, path = time.monotonic(), self.writer.path
        so_far = progress(path)
        given_up = {entry.station: entry for entry in so_far.skipped}
        todo = [k for k in range(len(self.plan.joints)) if k not in so_far.taken]
        todo = [k for k in todo if k not in given_up] + (sorted(given_up) if self.again else [])
        taken, in_a_row = 0, 0
        try:
            for k in todo:
                reason = self._station(k)
                if reason is None:
                    taken, in_a_row = taken + 1, 0
                    given_up.pop(k, None)
                    continue
                given_up[k] = Skipped(k, self.plan.labels[k], reason)
                note_skipped(path, given_up[k])
                self._say(f"{self.plan.labels[k]} skipped: {reason}")
                in_a_row += 1
                if in_a_row >= self.session.give_up:
                    raise CameraError(
                        f"{in_a_row} poses in a row without a frame, the last because: {reason};"
                        " expected a camera that delivers"
                    )
            self.interrupts.check()
        except (DepthbaError, OSError) as error:
            self.carrier.stop()
            raise SessionEnded(self._farewell(str(error))) from error
        except KeyboardInterrupt:
            self.carrier.stop()
            raise
        return Summary(
            path,
            len(self.plan.joints),
            len(self.writer),
            taken,
            tuple(given_up[k] for k in sorted(given_up)),
            self.plan.left_out,
            self._retries,
            self._stops,
            time.monotonic() - begin,
        )

    def _farewell(self, why: str) -> str:
        done, total = len(self.writer), len(self.plan.joints)
        return (
            f"{why}; the session ended with {done} of {total} frames whole in {self.writer.path}:"
            " the same command goes on with it"
        )

    def _say(self, text: str) -> None:
        self.listeners.say(text, len(self.writer), len(self.plan.joints))

    def _station(self, k: int) -> str | None:
        """Go there and take a frame; why there is none, or None."""
        label = self.plan.labels[k]
        self._say(f"to {label}")
        self._go(self.plan.joints[k])
        reason = "no frame"
        for attempt in range(self.session.retries + 1):
            if attempt:
                self._retries += 1
                self._say(f"{label}: {reason}; once more")
            try:
                found = self._frame(k)
            except Stopped as stop:
                self._await_release(stop)
                self._go(self.plan.joints[k])
                found = f"a safety stop came up: {stop}"
            if found is None:
                return None
            reason = found
        return reason

    def _go(self, target: Array) -> None:
        """Move to joints (n,) and wait until the rig has settled; asks after a safety stop."""
        while True:
            try:
                here = self.carrier.state().joints
                legs, reason = self.space.way(here, target)
                reason = self.space.why_not(target) or reason
                if reason is not None:
                    raise RigError(
                        f"{self.carrier.who}: no way from where the rig stands to the next pose:"
                        f" {reason}; expected it to stand within the limits: move it there by hand"
                    )
                for leg in legs:
                    self.interrupts.check()
                    self.carrier.move(leg)
                time.sleep(self.session.motion.settle)
                return
            except Stopped as stop:
                self._await_release(stop)

    def _await_release(self, stop: Stopped) -> None:
        """Ask until somebody has looked after the rig and it obeys again; else raise."""
        error: RigError = stop
        while self.listeners.ask(f"{error}. Released, and go on?"):
            try:
                self.carrier.connect()
                self.carrier.make_ready()
                self.carrier.state()
            except RigError as still:
                error = still
            else:
                self._stops += 1
                return
        raise error

    def _frame(self, k: int) -> str | None:
        """Take one frame where the rig stands and commit it; why not, or None."""
        session = self.session
        try:
            standing = await_still(self.carrier, session.motion)
            away = float(np.abs(standing.joints - self.plan.joints[k]).max())
            if away > 10.0 * session.motion.still:
                raise RigError(
                    f"{self.carrier.who}: stands {away:.3g} {self.space.body.unit} from"
                    f" {self.plan.labels[k]}, expected at most {10.0 * session.motion.still:g}"
                )
            self.interrupts.check()
            since = self._clock.now()
            capture = self.camera.capture(session.camera.timeout)
            now, stamp = self._clock.now(), self._clock.of(capture)
            after = self.carrier.state()
        except CameraTimeout as error:
            self._revive()
            return str(error)
        T_world_camera = self.space.T_world_base @ standing.T_base_flange
        T_world_camera = T_world_camera @ self.space.T_flange_camera
        self.listeners.moved(T_world_camera, since)
        jumped = capture.stamp - stamp
        since, now = since + jumped, now + jumped
        reason = self._moved(standing, after) or check(
            capture, self.info, session.frames, since=since, now=now, before=self._before
        )
        if reason is not None:
            return reason
        self._before = capture
        self._commit(k, standing, T_world_camera, replace(capture, stamp=stamp))
        return None

    def _revive(self) -> None:
        """A camera whose process had to be ended is opened anew."""
        if getattr(self.camera, "pid", 0) is None:
            self.camera.open()

    def _moved(self, before: Standing, after: Standing) -> str | None:
        moved = float(np.abs(after.joints - before.joints).max())
        most = 0.1 * self.session.motion.still
        if moved <= most:
            return None
        return (
            f"the rig moved by {moved:.3g} {self.space.body.unit} during the exposure, expected at"
            f" most {most:g}"
        )

    def _commit(self, k: int, standing: Standing, T_world_camera: Array, capture: Capture) -> None:
        notes: dict[str, Any] = {
            "station": k,
            "label": self.plan.labels[k],
            "rig_stamp": standing.stamp,
        }
        with self.interrupts.held():
            frame = self.writer.add_frame(
                stamp=capture.stamp,
                T_world_camera=T_world_camera,
                depth=capture.depth,
                rgb=capture.rgb if self.session.colour else None,
                T_world_camera_true=capture.T_world_camera_true,
                joints=standing.joints,
                T_base_flange=standing.T_base_flange,
                notes=notes,
            )
            self.listeners.committed(frame)
        self._say(f"{self.plan.labels[k]} taken")
