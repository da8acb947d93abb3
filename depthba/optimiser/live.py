"""Frames one at a time: each is placed on what is known, and all settle a little."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from depthba import se3
from depthba.dataset import Frame, Sensor
from depthba.dataset.listing import STAMP_TOLERANCE
from depthba.dataset.sensor import PoseNoise
from depthba.errors import DatasetError
from depthba.optimiser import schedule
from depthba.optimiser.asking import listening
from depthba.optimiser.clock import Clock
from depthba.optimiser.conclusion import conclude
from depthba.optimiser.ending import gone_on
from depthba.optimiser.engine import PASSING, Engine
from depthba.optimiser.overlap import held_frames, overlap_matrix
from depthba.optimiser.prior import pose_prior
from depthba.optimiser.problem import (
    FramePoints,
    Problem,
    bounds,
    check_roi,
    choose_map_frame,
    crop,
    frame_points,
    point_spacing,
    points_of,
    repeat_reason,
    typical_noise,
)
from depthba.optimiser.solvable import solvable
from depthba.optimiser.start import hand_eye_sigmas, pose_sigmas, reach_of_poses
from depthba.optimiser.waves import waves_of
from depthba.optimiser.workers import Workers
from depthba.options import Options
from depthba.result import Result

# Frames on whose ground a new one is placed: those that share most with it.
NEIGHBOURS = 6
# While frames still come, the map is this many times coarser than at the end.
COARSER = 2.0
# Iterations in which all frames settle after each new one.
SETTLING = 4


@dataclass(frozen=True)
class Update:
    """What a new frame did."""

    frame: int
    """Its id."""
    T_world_camera: NDArray[np.float64]
    """(N, 4, 4), of all frames so far, the new one last."""
    overlap: float
    """Largest share of its cells that one other frame sees too."""
    held: str
    """Why it stays where it was measured; empty where it was placed."""
    seconds: float


class Registration:
    """Registers frames as they come.

    A frame is first placed on the ground of its neighbours, which stand still, from where its
    measured pose says relative to the frame before. Then all frames settle together on a coarse
    map, from where they are. :meth:`result` ends on the finest map and says how certain it is;
    frames may come after it too.
    """

    def __init__(
        self,
        sensor: Sensor,
        options: Options | None = None,
        map_frame: str = "auto",
        pose_noise: PoseNoise | None = None,
        cancel: Callable[[], bool] | None = None,
    ) -> None:
        """Begin without frames.

        Args:
            sensor: of all frames.
            options: how; ``init`` is of no account. The defaults where None.
            map_frame: ``auto`` (faces the first frame's view) or ``world``.
            pose_noise: standard deviations of the measured poses; None: the usual ones.
            cancel: see `depthba.register`.

        Raises:
            OptionError: an option makes no sense.
        """
        self.options = options or Options()
        schedule.check(self.options)
        if self.options.roi is not None:
            check_roi(self.options.roi)
        self._sensor, self._map_frame = sensor, map_frame
        self._sigmas = pose_sigmas(pose_noise, self.options)
        self._hand_eye = hand_eye_sigmas(pose_noise, self.options)
        self._reach = reach_of_poses(pose_noise, self.options)
        self._stated = pose_noise is not None or None not in (
            self.options.prior_t,
            self.options.prior_r,
        )
        self._cancel = cancel
        self._workers = Workers(self.options.threads or os.cpu_count() or 1, cancel)
        self._ids: list[int] = []
        self._digests: dict[bytes, int] = {}
        self._stamps: list[float] = []
        self._frames: list[FramePoints] = []
        self._T_world_measured: list[NDArray[np.float64]] = []
        self._T_map_camera: list[NDArray[np.float64]] = []
        self._T_map_world = np.eye(4)
        self._typical = self._spacing = 1.0

    def __len__(self) -> int:
        return len(self._ids)

    def __enter__(self) -> Registration:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of threads and memory."""
        self._workers.close()

    def add(self, frame: Frame) -> Update:
        """Take one more frame.

        A frame that repeats an earlier one to the last digit stays where it was measured.

        Raises:
            DatasetError: the frame is damaged or of another sensor, its id or stamp is taken, its
                pose is none, or the first has no points.
            Unsolvable: lengths are such that the equations cannot be solved.
            Cancelled: ``cancel`` said so; the frame was not taken.
        """
        with listening(self._cancel), threadpool_limits(1, "blas"):
            return self._add(frame)

    def result(self) -> Result:
        """Settle all frames on the finest map and judge the outcome.

        Raises:
            DatasetError: fewer than two frames have points.
            Cancelled: ``cancel`` said so.
        """
        with listening(self._cancel), threadpool_limits(1, "blas"):
            return self._result()

    def _add(self, frame: Frame) -> Update:
        began = time.perf_counter()
        self._check(frame)
        cloud = points_of(frame)
        digest = hashlib.sha256(cloud.tobytes()).digest()
        earlier = self._digests.get(digest) if len(cloud) else None
        if earlier is not None:
            cloud = cloud[:0]
        if not self._ids:
            if not len(cloud):
                raise DatasetError(f"frame {frame.id}: the first frame has no valid depth")
            self._begin(frame, cloud)
        measured = self._T_map_world @ frame.T_world_camera
        if self._ids:
            before = self._T_map_world @ self._T_world_measured[-1]
            T = self._T_map_camera[-1] @ se3.inverse(before) @ measured
        else:
            T = measured
        if self.options.roi is not None:
            cloud = crop(cloud, T, self.options.roi)
        points = frame_points(cloud, self._sensor, self._typical)
        if earlier is not None:
            points = replace(points, refused=repeat_reason(earlier))
        frames = [*self._frames, points]
        poses = np.stack([*self._T_map_camera, T])
        worlds = np.stack([*self._T_world_measured, frame.T_world_camera])
        problem = self._problem(frames, worlds)
        overlap = overlap_matrix(problem, poses, problem.spacing)
        held = held_frames(problem, overlap)
        if len(frames) > 1 and not held[-1]:
            with solvable(problem, f"frame {frame.id}"):
                poses = self._placed(problem, poses, overlap)
                poses = self._settled(problem, poses, held)
        self._digests.setdefault(digest, frame.id)
        self._ids.append(frame.id)
        self._stamps.append(frame.stamp)
        self._frames = frames
        self._T_world_measured.append(frame.T_world_camera)
        self._T_map_camera = list(poses)
        return Update(
            frame=frame.id,
            T_world_camera=se3.inverse(self._T_map_world) @ poses,
            overlap=float(np.delete(overlap[-1], -1).max(initial=0.0)),
            held=held[-1],
            seconds=time.perf_counter() - began,
        )

    def _result(self) -> Result:
        if sum(len(f) > 0 for f in self._frames) < 2:
            raise DatasetError("registration needs 2 or more frames with valid depth")
        measured = np.stack(self._T_world_measured)
        problem = self._problem(self._frames, measured)
        finest = self.options.resolution or schedule.finest_spacing(problem)
        overlap = overlap_matrix(problem, problem.T_map_camera, finest)
        held = held_frames(problem, overlap)
        engine = self._engine(problem, np.array([not why for why in held]))
        poses = np.stack(self._T_map_camera)
        ids, stamps = tuple(self._ids), tuple(self._stamps)
        with solvable(problem, f"{len(self)} frames"):
            end = engine.run([COARSER * finest, finest], poses, refining=True)
            end, known = gone_on(engine, end)
            result = conclude(
                engine, end, known, ids, stamps, measured, held, overlap, self._stated
            )
        self._T_map_camera = list(end.outcome.state.T_map_camera)
        return result

    def _check(self, frame: Frame) -> None:
        """Refuse a frame that does not go with the others."""
        if frame.id in self._ids:
            raise DatasetError(f"frame {frame.id} was added before")
        if any(abs(frame.stamp - stamp) <= STAMP_TOLERANCE for stamp in self._stamps):
            raise DatasetError(
                f"frame {frame.id}: stamp {frame.stamp:.9f} is taken, expected one of its own"
            )
        if frame.sensor != self._sensor:
            raise DatasetError(
                f"frame {frame.id}: was taken by {_shown(frame.sensor)}, expected "
                f"{_shown(self._sensor)} as the registration began with"
            )
        if not se3.is_rigid(frame.T_world_camera):
            raise DatasetError(
                f"frame {frame.id}: its pose is {frame.T_world_camera.tolist()}, expected a rigid "
                "transform (4, 4)"
            )

    def _begin(self, frame: Frame, cloud: NDArray[np.float32]) -> None:
        self._T_map_world = choose_map_frame(self._map_frame, [cloud], frame.T_world_camera[None])
        self._typical = typical_noise(self._sensor, [cloud])
        self._spacing = point_spacing(self._sensor, [cloud])

    def _problem(self, frames: list[FramePoints], T_world_camera: NDArray[np.float64]) -> Problem:
        start = self._T_map_world @ T_world_camera
        lower, upper = bounds([f.points for f in frames], start)
        return Problem(
            frames=tuple(frames),
            T_map_camera=start,
            T_map_world=self._T_map_world,
            lower=lower,
            upper=upper,
            origin=self._sensor.origin,
            spacing=self._spacing,
            noise=self._typical if self._sensor.noise is not None else None,
            waves=waves_of(self._sensor, self._typical),
            step=self._sensor.depth_scale or 0.0,
        )

    def _engine(self, problem: Problem, free: NDArray[np.bool_]) -> Engine:
        prior = pose_prior(
            problem.T_map_camera, self._T_map_world[:3, :3], *self._sigmas,
            np.arange(len(free)) == 0, self._hand_eye,
        )  # fmt: skip
        return Engine(
            problem, self.options, prior, free, self._workers, Clock(self.options.time_limit)
        )

    def _placed(
        self, problem: Problem, poses: NDArray[np.float64], overlap: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Place the last frame on its neighbours, which stand still."""
        new = len(poses) - 1
        near = np.argsort(-overlap[new, :new], kind="stable")[:NEIGHBOURS]
        chosen = [*sorted(int(i) for i in near if overlap[new, i] > 0), new]
        part = replace(
            problem,
            frames=tuple(problem.frames[i] for i in chosen),
            T_map_camera=poses[chosen],
        )
        lower, upper = bounds([problem.frames[i].points for i in chosen], poses[chosen])
        part = replace(part, lower=lower, upper=upper)
        finest = COARSER * (self.options.resolution or schedule.finest_spacing(problem))
        levels = [s for s in schedule.spacings(self.options, part, *self._reach) if s > finest] or [
            finest
        ]
        engine = self._engine(part, np.arange(len(chosen)) == len(chosen) - 1)
        engine.settled = PASSING
        out = poses.copy()
        out[new] = engine.run(levels, poses[chosen]).outcome.state.T_map_camera[-1]
        return out

    def _settled(
        self, problem: Problem, poses: NDArray[np.float64], held: list[str]
    ) -> NDArray[np.float64]:
        """Let all frames settle together on a coarse map, from where they are."""
        finest = self.options.resolution or schedule.finest_spacing(problem)
        engine = self._engine(problem, np.array([not why for why in held]))
        engine.options = replace(self.options, max_iterations=SETTLING)
        engine.settled = PASSING
        end = engine.run([COARSER * finest], poses, refining=True)
        return end.outcome.state.T_map_camera


def _shown(sensor: Sensor) -> str:
    """Name a sensor for people."""
    lens = sensor.camera
    kind = sensor.kind if lens is None else f"{lens.width} x {lens.height}, fx {lens.fx:g}"
    return f"a sensor {sensor.model!r} ({kind})"
