"""The rigs that carry the sensor: where they take frames, and how wrong their pose reports are.

The truth is the planned pose; everything that a rig does not know about itself is in the reported
poses. A rig's reports are `T_base_flange` (encoders) times the believed `T_flange_camera`, with the
world in the rig's base.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Protocol, cast

from sim.errors import SimulationError

if TYPE_CHECKING:
    from sim.engine import mujoco
    from sim.rigs.track import Track


class Rig(Protocol):
    """Something that carries a sensor from pose to pose."""

    @property
    def frames(self) -> int:
        """How many it takes unless told otherwise."""

    def track(
        self,
        model: mujoco.MjModel,
        seed: int,
        frames: int | None = None,
        start_error: tuple[float, float] | None = None,
        scale: float = 1.0,
    ) -> Track:
        """The poses of a capture in the compiled scene `model`.

        `frames`: how many, None the rig's own. `scale` multiplies the rig's errors (0: reports are
        exact). `start_error` (m, rad) replaces them by independent Gaussian errors per axis, frame
        0 exact, for studies.
        """


RIGS: dict[str, str] = {
    "arm": "sim.rigs.arm:Arm",
    "board-arm": "sim.rigs.board_arm:BoardArm",
    "dome": "sim.rigs.dome:Dome",
    "gantry": "sim.rigs.gantry:Gantry",
}
"""A class for each name, imported when it is wanted; called without arguments."""


def find_rig(rig: str | Rig) -> Rig:
    """The rig called `rig`, or the rig itself; SimulationError lists the choices."""
    if not isinstance(rig, str):
        return rig
    if rig not in RIGS:
        raise SimulationError(f"unknown rig {rig!r}; choose one of: {', '.join(sorted(RIGS))}")
    module, name = RIGS[rig].split(":")
    return cast("Rig", getattr(importlib.import_module(module), name)())
