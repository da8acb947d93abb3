"""The arm of a hand-eye calibration: it looks at the board from all sides."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from depthba.board_views import Views
from depthba.camera import Camera
from sim.calibration import board_of
from sim.engine import mujoco
from sim.errors import SimulationError
from sim.rigs.arm import Arm
from sim.rigs.track import Track
from sim.sensors import ZED2

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BoardArm:
    """A UR16e whose camera looks at the calibration board of the scene."""

    views: Views = field(default_factory=Views)
    arm: Arm = field(default_factory=lambda: Arm(frames=20, overlap=0.0))
    """Its aims are replaced by the views."""
    camera: Camera = field(default_factory=lambda: ZED2.camera)
    """What the views are made for; one that sees further to every side will do too."""

    @property
    def frames(self) -> int:
        """How many it takes unless told otherwise."""
        return self.arm.frames

    def track(
        self,
        model: mujoco.MjModel,
        seed: int,
        frames: int | None = None,
        start_error: tuple[float, float] | None = None,
        scale: float = 1.0,
    ) -> Track:
        """The capture's poses in a model that holds the arm and a board; else as `Arm.track`.

        SimulationError if there is no board in it.
        """
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        found = board_of(model, data)
        if found is None:
            raise SimulationError(
                "the scene has no calibration board: expected a text and a site called 'board'"
            )
        board, T_world_board = found

        def aims(rng: np.random.Generator, count: int) -> Iterator[Array]:
            for T_board_camera in self.views.wanted(board, self.camera, count, rng):
                yield T_world_board @ T_board_camera

        return replace(self.arm, aims=aims).track(model, seed, frames, start_error, scale)
