"""A rehearsal: the same session against a simulated rig, whose processes end with it."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from depthba.errors import OptionError
from rig.cameras import find
from rig.errors import RigError
from rig.plain import from_plain
from rig.session.children import START, Child, address
from rig.session.options import CameraChoice, Session, plain
from rig.session.rehearsed_gantry import PATIENCE, gantry

if TYPE_CHECKING:
    from rig.arms.ur import UrOptions

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
    with contextlib.ExitStack() as stack:
        if session.rig.kind == "ur":
            host = _controller(stack, session, speed)
            options, more = _arm(session.rig.options, host), {}
        else:
            simulated = gantry(stack, session, speed)
            host, options, more = simulated.host, simulated.options, simulated.camera
        yield dataclasses.replace(
            session,
            rig=dataclasses.replace(session.rig, options=options),
            camera=_camera(session, host, more),
            motion=dataclasses.replace(session.motion, settle=session.motion.settle / speed),
        )


def _camera(session: Session, host: str, more: dict[str, Any]) -> CameraChoice:
    """The simulated camera on the simulated rig at an address."""
    scene = session.rehearsal
    values: dict[str, Any] = {"seed": scene.seed, "sensor": scene.sensor, "size": scene.size}
    if session.camera.kind == "simulated":
        values = plain(session.camera.options)
    values = more | {key: value for key, value in values.items() if value is not None}
    options = from_plain(find("simulated").Options, values | {"host": host}, "camera 'simulated'")
    return dataclasses.replace(session.camera, kind="simulated", options=options)


def _arm(options: UrOptions, host: str) -> UrOptions:
    """How the simulated arm at an address is reached.

    It shares this machine with everything else, and may have to wait for its turn.
    """
    return dataclasses.replace(
        options,
        host=host,
        patience=max(options.patience, PATIENCE),
        silence=max(options.silence, PATIENCE),
        standstill=max(options.standstill, PATIENCE),
    )


def _controller(stack: contextlib.ExitStack, session: Session, speed: float) -> str:
    """Start a simulated controller, and return the address at which it is ready."""
    said = ""
    for _ in range(_TRIES):
        host = address()
        child = stack.enter_context(Child(_words(session, host, speed)))
        if child.said(START, _whole) is not None:
            return host
        said = child.last_words()
        if "in use" not in said:
            break
    raise RigError(f"the simulated controller does not start: {said or 'it says nothing'}")


def _whole(text: str) -> Any:
    """What a JSON object says, once it is there."""
    with contextlib.suppress(ValueError):
        return json.loads(text)
    return None


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
