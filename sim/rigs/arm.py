"""A camera on a UR16e's flange: where it takes frames, and what the arm reports of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from depthba.errors import OptionError
from depthba.kinematics import UR16E, DhArm
from sim.engine import mujoco
from sim.rigs.arm_errors import ArmErrors, report
from sim.rigs.clearance import joint_addresses
from sim.rigs.planning import Plan, plan
from sim.rigs.table_dome import TableDome
from sim.rigs.track import Track, perturbed
from sim.robots.ur16e import T_FLANGE_CAMERA
from sim.seeds import stream

Array = NDArray[np.float64]
Aims = Callable[[np.random.Generator, int], Iterable[Array]]
"""From random numbers and a number of frames to the wanted poses, as `sim.rigs.planning.plan` takes
them."""


@dataclass(frozen=True)
class Arm:
    """A UR16e that carries a stereo camera from pose to pose; it must be in the scene's model."""

    frames: int = 12
    """Frames of a capture."""
    aims: Aims = field(default_factory=TableDome)
    """Where the camera should look from."""
    overlap: float = 0.5
    """Least share of the view of the plane z = 0 that consecutive frames have in common."""
    dh: DhArm = UR16E
    """The arm's kinematics, the same to the model, to the truth and to the reports."""
    T_flange_camera: Array = field(default_factory=lambda: T_FLANGE_CAMERA)
    """(4, 4) where the camera truly sits."""
    errors: ArmErrors = field(default_factory=ArmErrors)
    speed: float = 0.8
    """Of the fastest joint on the way, rad/s."""
    settle: float = 1.5
    """From arrival to the exposure, s."""

    def plan(self, model: mujoco.MjModel, seed: int, frames: int | None = None) -> Plan:
        """The poses of a capture; SimulationError if the scene does not allow so many."""
        count = self.frames if frames is None else frames
        if count < 1:
            raise OptionError(f"frames {count}: expected 1 or more")
        wanted = self.aims(stream(seed, "arm"), count)
        return plan(
            model,
            wanted,
            count,
            arm=self.dh,
            T_flange_camera=self.T_flange_camera,
            overlap=self.overlap,
        )

    def track(
        self,
        model: mujoco.MjModel,
        seed: int,
        frames: int | None = None,
        start_error: tuple[float, float] | None = None,
        scale: float = 1.0,
    ) -> Track:
        """The capture's poses in a model that holds the arm.

        `scale` multiplies the arm's errors (0: reports are exact). `start_error` (m, rad) replaces
        them by independent Gaussian errors per axis, frame 0 exact, for studies; joints are
        not reported then. SimulationError if the model lacks the arm, or leaves it no room.
        """
        return self.track_of(self.plan(model, seed, frames), model, seed, start_error, scale)

    def track_of(
        self,
        planned: Plan,
        model: mujoco.MjModel,
        seed: int,
        start_error: tuple[float, float] | None = None,
        scale: float = 1.0,
    ) -> Track:
        """The capture of a plan made before; see `track`."""
        stamps, qpos = self._stamps(planned.q), self._qpos(model, planned.q)
        T_true = planned.T_world_camera
        if start_error is not None:
            return replace(perturbed(stamps, T_true, seed, start_error), qpos=qpos)
        if scale == 0.0:
            return Track(
                stamps,
                T_true,
                T_true,
                T_base_flange=self.dh.forward(planned.q),
                T_flange_camera=self.T_flange_camera,
                T_flange_camera_true=self.T_flange_camera,
                joints=planned.q,
                qpos=qpos,
            )
        reports = report(
            self.dh,
            planned.q,
            planned.T_world_base,
            self.T_flange_camera,
            self.errors,
            seed,
            scale,
        )
        return Track(
            stamps,
            T_true,
            planned.T_world_base @ reports.T_base_flange @ reports.T_flange_camera,
            reports.sigma_t,
            reports.sigma_r,
            T_base_flange=reports.T_base_flange,
            T_flange_camera=reports.T_flange_camera,
            T_flange_camera_true=self.T_flange_camera,
            joints=reports.joints,
            qpos=qpos,
        )

    def _stamps(self, q: Array) -> Array:
        """(N,) s, to the millisecond: each frame after its way and the time to settle."""
        way = np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0) / self.speed + self.settle
        return np.round(np.concatenate([[0.0], np.cumsum(way)]), 3)

    def _qpos(self, model: mujoco.MjModel, q: Array) -> Array:
        """(N, nq): the arm's joints, everything else where the model has it."""
        qpos = np.repeat(np.asarray(model.qpos0, float)[None], len(q), axis=0)
        qpos[:, joint_addresses(model, self.dh.joints)] = q
        return qpos
