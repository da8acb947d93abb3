"""Where a simulated gantry stands, for the simulated camera on its carriage.

The camera asks on a channel of its own, one JSON object a line, as it asks the simulated arm's
controller: what scene it looks at, and where the carriage truly is at this instant.
"""

from __future__ import annotations

import json
import os
import socketserver
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba.errors import OptionError
from sim.axes.serving import check_loopback
from sim.controller.options import CONTROL_PORT
from sim.seeds import stream

Array = NDArray[np.float64]

Vector = tuple[float, float, float]
Row = tuple[float, float, float, float]


@dataclass(frozen=True)
class Stage:
    """The scene around a gantry. Without one nothing can be seen, and nobody is told the truth."""

    scene: str | None = None
    """As `depthba generate` takes it."""
    seed: int = 0
    """Of the scene and of the axes' zeros."""
    host: str = "127.0.0.9"
    """Loopback address at which the camera asks."""
    control_port: int = CONTROL_PORT
    T_world_base: tuple[Row, Row, Row, Row] = (
        (1.0, 0.0, 0.0, 0.0),
        (0.0, 1.0, 0.0, 0.0),
        (0.0, 0.0, 1.0, 0.0),
        (0.0, 0.0, 0.0, 1.0),
    )
    """Where the carriage is with its axes at 0."""
    directions: tuple[Vector, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Unit vectors along which the axes lead, base frame."""
    zero_offset: float = 0.0
    """Standard deviation of each axis's zero, m: the controller knows nothing of it."""

    def carriage(self, position: Array) -> Array:
        """T_world_flange (4, 4) with the axes at (n,), m, as they read."""
        n = len(position)
        if n > len(self.directions):
            raise OptionError(f"{len(self.directions)} directions, expected one for each of {n}")
        rng = stream(self.seed, "gantry", "zeros")
        true = position + self.zero_offset * rng.standard_normal(n)
        T = np.array(self.T_world_base, float)
        T[:3, 3] += T[:3, :3] @ (true @ np.array(self.directions[:n], float))
        return T


def tell(stage: Stage, position: Callable[[], Array]) -> None:
    """Answer the camera from a thread of its own, as long as this process lives.

    Args:
        stage: what is simulated; without a scene nobody is answered.
        position: gives where the axes are now (n,), m.

    Raises OptionError for an address that is no loopback, or taken.
    """
    if stage.scene is None:
        return
    check_loopback(stage.host)

    class Answers(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            for line in self.rfile:
                answer = json.dumps(_answer(stage, position, line))
                self.wfile.write(answer.encode() + b"\n")

    class Server(socketserver.ThreadingTCPServer):
        allow_reuse_address = True
        daemon_threads = True

    try:
        server = Server((stage.host, stage.control_port), Answers)
    except OSError as error:
        raise OptionError(
            f"{stage.host}:{stage.control_port}: {error.strerror}, expected a free address"
        ) from None
    threading.Thread(target=server.serve_forever, daemon=True).start()


def _answer(stage: Stage, position: Callable[[], Array], line: bytes) -> dict[str, Any]:
    try:
        do = json.loads(line)["do"]
    except (ValueError, TypeError, KeyError):
        return {"ok": False, "error": "expected a JSON object with the key do"}
    if do == "about":
        about: dict[str, Any] = {
            "scene": stage.scene,
            "seed": stage.seed,
            "pid": os.getpid(),
            "joint_names": [],
        }
        return {"ok": True, **about}
    if do in ("expose", "truth"):
        T = stage.carriage(position())
        now = time.monotonic()
        return {"ok": True, "time": now, "joints": [], "T_world_flange": T.tolist()}
    return {"ok": False, "error": f"do {do!r}: choose from: about, expose, truth"}
