"""A rehearsal: the same session against a simulated rig, whose processes end with it."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import queue
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from depthba.errors import OptionError
from rig.cameras import find
from rig.errors import RigError
from rig.plain import from_plain
from rig.session.options import Session, plain

START = 90.0
"""For a simulated controller to be ready, s."""
_PATIENCE = 10.0
"""How long a simulated rig may say nothing at least, s."""
_TRIES = 5
"""Addresses that are tried where others have taken one."""


@contextlib.contextmanager
def rehearsed(session: Session, speed: float) -> Iterator[Session]:
    """Give the session with a simulated rig and camera in place of its own, on 127.a.b.c.

    All processes end with the block, whatever ends it, and with this process.

    Args:
        session: what is rehearsed; its `rehearsal` says in which scene.
        speed: simulated seconds in a second.

    Raises:
        OptionError: the rig cannot be rehearsed, or the speed makes no sense.
        RigError: the simulated rig does not start; says why.
    """
    if not 0.01 <= speed <= 100.0:
        raise OptionError(f"--speed {speed:g}: expected 0.01 to 100")
    if session.rig.kind != "ur":
        raise OptionError(
            f"a rig of kind {session.rig.kind} cannot be rehearsed in a scene, expected ur; its"
            " moves can: see the simulated gantries in docs/devices.md"
        )
    with contextlib.ExitStack() as stack:
        host = _controller(stack, session, speed)
        yield _simulated(session, host, speed)


def _simulated(session: Session, host: str, speed: float) -> Session:
    """The session as it runs against the simulated rig at an address."""
    scene = session.rehearsal
    values: dict[str, Any] = {"seed": scene.seed, "sensor": scene.sensor, "size": scene.size}
    if session.camera.kind == "simulated":
        values = plain(session.camera.options)
    options = from_plain(find("simulated").Options, values | {"host": host}, "camera 'simulated'")
    # The simulated rig shares this machine with everything else, and may have to wait for its turn.
    reached = dataclasses.replace(
        session.rig.options,
        host=host,
        patience=max(session.rig.options.patience, _PATIENCE),
        silence=max(session.rig.options.silence, _PATIENCE),
        standstill=max(session.rig.options.standstill, _PATIENCE),
    )
    return dataclasses.replace(
        session,
        rig=dataclasses.replace(session.rig, options=reached),
        camera=dataclasses.replace(session.camera, kind="simulated", options=options),
        motion=dataclasses.replace(session.motion, settle=session.motion.settle / speed),
    )


def _controller(stack: contextlib.ExitStack, session: Session, speed: float) -> str:
    """Start a simulated controller, and return the address at which it is ready."""
    said = ""
    for _ in range(_TRIES):
        host = _address()
        process = stack.enter_context(_Process(_words(session, host, speed)))
        if process.ready(START):
            return host
        said = process.last_words()
        if "in use" not in said:
            break
    raise RigError(f"the simulated controller does not start: {said or 'it says nothing'}")


def _words(session: Session, host: str, speed: float) -> list[str]:
    scene, calibration = session.rehearsal, session.rig.options.calibration
    words = [sys.executable, "-m", "depthba", "simulate-controller", "--json", "--end-with-parent"]
    words += ["--host", host, "--speed", repr(speed)]
    words += ["--scene", scene.scene, "--seed", str(scene.seed)]
    words += ["--joint-offset", repr(scene.joint_offset)]
    if scene.joints is not None:
        words += ["--joints", *map(repr, scene.joints)]
    if calibration is not None:
        words += ["--calibration", str(calibration)]
    return words


def _address() -> str:
    """A loopback address that hardly any other process takes."""
    rng = random.Random(os.getpid() ^ time.time_ns())
    return f"127.{rng.randint(16, 254)}.{rng.randint(0, 254)}.{rng.randint(2, 254)}"


class _Process:
    """A child that says on stdout, in a JSON object, that it is ready."""

    def __init__(self, words: list[str]) -> None:
        root = str(Path(__file__).parents[2])
        environment = dict(os.environ)
        paths = [root, *filter(None, [environment.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        # Ctrl-C at the terminal is for the session: the robot must be there to be braked.
        self._child = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=environment,
            start_new_session=True,
        )
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        threading.Thread(target=self._hear, daemon=True).start()

    def __enter__(self) -> _Process:
        return self

    def __exit__(self, *error: object) -> None:
        self._child.terminate()
        try:
            self._child.wait(2.0)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._errors.close()

    def ready(self, timeout: float) -> bool:
        """Wait for the object; False: the child ended, or took too long."""
        text, deadline = "", time.monotonic() + timeout
        while True:
            try:
                line = self._lines.get(timeout=max(deadline - time.monotonic(), 0.0))
            except queue.Empty:
                return False
            if line is None:
                return False
            text += line
            with contextlib.suppress(ValueError):
                json.loads(text)
                return True

    def last_words(self) -> str:
        """The last line that it wrote on stderr."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(1.0)
        self._errors.seek(0)
        lines = self._errors.read().decode("utf-8", "replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "")

    def _hear(self) -> None:
        assert self._child.stdout is not None
        with self._child.stdout as stream:
            for line in stream:
                self._lines.put(line)
        self._lines.put(None)
