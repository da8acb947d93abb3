"""A simulated gantry for a rehearsal: what the session's own controller would be, in a scene."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.errors import OptionError
from rig.axes.modbus_map import RegisterMap
from rig.errors import RigError
from rig.session.children import START, Child, address
from rig.session.options import Rehearsal, Session

Array = NDArray[np.float64]

PATIENCE = 10.0
"""How long a simulated rig may say nothing at least, s."""
_BEYOND = 0.01
"""By how much the simulated rails are longer than the session's limits, m."""
_COUNT = 1e-6
"""Of the simulated controller, m."""


@dataclass(frozen=True)
class SimulatedGantry:
    """A gantry that is ready."""

    host: str
    """Where its camera asks."""
    options: Any
    """Of the driver, as it reaches the simulated one."""
    camera: dict[str, Any]
    """Options of the simulated camera."""


def gantry(stack: contextlib.ExitStack, session: Session, speed: float) -> SimulatedGantry:
    """Start the gantry that a session drives, to end with `stack`.

    Raises:
        OptionError: an axis that no simulated gantry has.
        RigError: it does not start; says why.
    """
    host, options, kind = address(), session.rig.options, session.rig.kind
    lower = np.array([axis.lower for axis in options.axes])
    upper = np.array([axis.upper for axis in options.axes])
    if kind == "grbl" and lower.min() < 0.0:
        raise OptionError(
            f"axis {options.axes[int(lower.argmin())].name}: lower {lower.min():g} m, expected 0 or"
            " more: the simulated GRBL counts from its switches"
        )
    lowest, furthest = np.minimum(lower, 0.0) - _BEYOND, upper + _BEYOND
    words = [sys.executable, "-m", f"sim.axes.{kind}_device", "--end-with-parent"]
    words += ["--rate", repr(speed)]
    for name, values in (("lower", lowest), ("upper", furthest), ("parked", 0.3 * furthest)):
        words += [f"--mechanics.{name}", *map(repr, map(float, values))]
    words += _stage(session, host)
    if kind == "modbus":
        words += ["--host", host, "--port", "0", "--watchdog", repr(PATIENCE)]
    child = stack.enter_context(Child(words))
    where = child.said(START, _where)
    if where is None:
        raise RigError(
            f"the simulated gantry does not start: {child.last_words() or 'it says nothing'}"
        )
    truth = _mounted(np.array(session.hand_eye), session.rehearsal)
    camera = {"T_flange_camera": truth.tolist()}
    patience = dataclasses.replace(
        options.patience, stall=max(options.patience.stall, PATIENCE), settle=PATIENCE
    )
    reached: dict[str, Any] = {
        "patience": patience,
        "reply_timeout": max(options.reply_timeout, PATIENCE),
        # Its switches are as far away as its rails are long, and slow where its time is.
        "home_timeout": PATIENCE + 10.0 * float(furthest.max()) / speed,
    }
    if kind == "modbus":
        at = tuple(4 + 2 * k for k in range(len(options.axes)))
        reached |= {
            "host": host,
            "port": int(where.rpartition(":")[2]),
            "unit": 1,
            "metres_per_count": _COUNT,
            "registers": RegisterMap(targets=at, positions=at),
        }
    else:
        # GRBL counts down from the far ends of the rails, where its switches are not.
        reached |= {"port": where, "origin": tuple((-furthest).tolist())}
    return SimulatedGantry(host, dataclasses.replace(options, **reached), camera)


def _stage(session: Session, host: str) -> list[str]:
    scene = session.rehearsal
    n = len(session.rig.options.axes)
    along = np.array(session.rig.directions[:n], float)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    words = ["--stage.scene", scene.scene, "--stage.seed", str(scene.seed), "--stage.host", host]
    words += ["--stage.zero-offset", repr(scene.joint_offset)]
    words += ["--stage.directions", *map(repr, along.ravel().tolist())]
    return [*words, "--stage.T-world-base", *map(repr, np.ravel(session.T_world_base).tolist())]


def _where(text: str) -> str | None:
    """Where it listens, once it has said so."""
    lines = [line for line in text.splitlines() if line.startswith("listening on ")]
    return lines[0].split()[-1] if lines else None


def _mounted(believed: Array, scene: Rehearsal) -> Array:
    """T_flange_camera (4, 4) as it truly is: as far off as the rehearsal says, some way."""
    rng = np.random.default_rng([scene.seed, 7])
    away, about = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    turn = np.radians(scene.mounting_r_deg) * about
    return np.asarray(se3.retract(believed, np.concatenate([scene.mounting_t * away, turn])))
