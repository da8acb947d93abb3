"""What a session file may say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from depthba import se3
from depthba.boards import Board
from depthba.dataset import PoseNoise
from depthba.errors import OptionError
from rig.cameras.checking import FrameLimits
from rig.session.marked import OPTIONS_OF
from rig.session.poses import Matrix, Point, Poses

Box = tuple[float, float, float, float, float, float]

IDENTITY: Matrix = (
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
)


def _rig_options(kind: str) -> Any:
    """The options of a driver; nothing but its own module is imported."""
    if kind == "ur":
        from rig.arms.ur import UrOptions

        return UrOptions
    if kind == "modbus":
        from rig.axes.modbus import ModbusOptions

        return ModbusOptions
    from rig.axes.grbl import GrblOptions

    return GrblOptions


def _camera_options(kind: str) -> Any:
    from rig.cameras import find

    return find(kind).Options


@dataclass(frozen=True)
class RigChoice:
    """What carries the camera."""

    kind: Literal["ur", "modbus", "grbl"]
    """ur: an arm of Universal Robots. modbus, grbl: a gantry behind such a controller."""
    options: Any = field(metadata={OPTIONS_OF: _rig_options})
    """Of the driver: `UrOptions`, `ModbusOptions` or `GrblOptions`."""
    directions: tuple[Point, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Of a gantry: where each axis leads in the base frame, in its axes' order; made unit length.
    The base frame is the carriage's at position 0."""

    def __post_init__(self) -> None:
        """OptionError names a direction of no length."""
        for direction in self.directions:
            if np.linalg.norm(direction) < 1e-9:
                raise OptionError(f"direction {direction}: expected one with a length")


@dataclass(frozen=True)
class CameraChoice:
    """Which camera, and how patient to be with it."""

    kind: str
    """As `rig.cameras.names` lists them."""
    options: Any = field(metadata={OPTIONS_OF: _camera_options})
    """Of that camera."""
    timeout: float = 3.0
    """For a frame, s."""
    open_timeout: float = 60.0
    """For the camera to start, s."""
    hang: float = 10.0
    """A camera that has said nothing so long after `timeout` hangs, and is started anew, s."""

    def __post_init__(self) -> None:
        """OptionError names a value that makes no sense."""
        _above_zero(self, "timeout", "open_timeout", "hang")


@dataclass(frozen=True)
class Motion:
    """How the rig goes from pose to pose."""

    move: Literal["joints", "linear"] = "joints"
    """Of an arm: straight in its joints, or in a straight line of the flange."""
    speed: float = 0.5
    """Of the fastest joint, rad/s; of the flange or of a gantry, m/s."""
    acceleration: float = 1.0
    """Of an arm: rad/s^2, m/s^2."""
    settle: float = 0.5
    """From the arrival to the exposure, s."""
    still: float = 0.002
    """What moves no faster stands, rad/s; as far as a joint may be away after the exposure, rad or
    m, divided by 10."""
    still_timeout: float = 5.0
    """For the rig to stand after it has arrived, s."""
    rest: tuple[float, ...] | None = None
    """Joints (rad) over which a way leads where the straight one would leave the limits."""

    def __post_init__(self) -> None:
        """OptionError names a value that makes no sense."""
        _above_zero(self, "speed", "acceleration", "still", "still_timeout")
        if self.settle < 0.0:
            raise OptionError(f"settle {self.settle}: expected 0 or more, s")


@dataclass(frozen=True)
class Limits:
    """Where the rig may be, on its way too. Boxes are xmin xmax ymin ymax zmin zmax."""

    camera: Box
    """For the camera's origin, world, m."""
    flange: Box | None = None
    """For the flange's or carriage's origin, world, m."""
    lower: tuple[float, ...] | None = None
    upper: tuple[float, ...] | None = None
    """For the joints, rad, within the arm's own. None: those alone."""
    arm_in_view: Literal["refuse", "allow"] = "refuse"
    """Poses in which the arm stands in its own camera's view: it would move with the camera."""

    def __post_init__(self) -> None:
        """OptionError names a box that holds nothing."""
        for name in ("camera", "flange"):
            box = getattr(self, name)
            if box is not None and not all(box[2 * k] < box[2 * k + 1] for k in range(3)):
                raise OptionError(
                    f"{name} {list(box)}: expected xmin xmax ymin ymax zmin zmax, each min below"
                    " its max, m"
                )


@dataclass(frozen=True)
class Rehearsal:
    """What ``--rehearse`` puts in place of the hardware."""

    scene: str = "lab-1"
    """As `depthba generate` takes it: around an arm as lab-1, under a gantry as industrial-4."""
    seed: int = 0
    """Of the scene and of the camera's noise."""
    sensor: str | None = None
    """As `depthba generate` takes it. None: the scene's."""
    size: tuple[int, int] | None = None
    """Width and height of the images, pixels. None: the sensor's."""
    joints: tuple[float, float, float, float, float, float] | None = None
    """Where the simulated arm stands at the start, rad. None: where it stands by itself."""
    joint_offset: float = 0.0
    """Standard deviation of each joint's zero, rad, or axis's, m, which nobody knows."""
    mounting_t: float = 0.002
    mounting_r_deg: float = 0.3
    """Of a gantry: how far its camera sits from where `hand_eye` has it. An arm's sits where the
    model of the arm has it."""


@dataclass(frozen=True)
class Session:
    """A capture session."""

    rig: RigChoice
    camera: CameraChoice
    hand_eye: Matrix | Path
    """T_flange_camera as believed (of a gantry: T_carriage_camera), or a file with it, as `depthba
    calibrate` writes."""
    poses: tuple[Poses, ...]
    limits: Limits
    name: str = ""
    """Of the dataset. "": the folder's."""
    T_world_base: Matrix = IDENTITY
    """Where the rig's base stands."""
    map_frame: Literal["world", "auto"] = "auto"
    """As dataset.json's."""
    motion: Motion = field(default_factory=Motion)
    frames: FrameLimits = field(default_factory=FrameLimits)
    """What a frame must be like."""
    retries: int = 2
    """How often more a frame is tried for at a pose before it is skipped."""
    give_up: int = 3
    """After so many poses skipped in a row the session ends: the camera is at fault."""
    order: Literal["shortest", "given"] = "shortest"
    unreachable: Literal["refuse", "leave out"] = "refuse"
    """What to do when a pose cannot be taken: nothing at all, or the rest."""
    colour: bool = True
    """Keep colour images where there are some."""
    pose_noise: PoseNoise | None = None
    """Believed standard deviation of the measured poses; goes into dataset.json."""
    rehearsal: Rehearsal = field(default_factory=Rehearsal)

    def __post_init__(self) -> None:
        """OptionError names a value that makes no sense, alone or with the others."""
        for name in ("hand_eye", "T_world_base"):
            T = getattr(self, name)
            if not isinstance(T, Path) and not se3.is_rigid(np.array(T)):
                raise OptionError(f"{name} is not rigid, expected a rotation and a place, m")
        if not self.poses:
            raise OptionError("poses: none, expected one or more")
        if self.retries < 0 or self.give_up < 1:
            raise OptionError(
                f"retries {self.retries}, give_up {self.give_up}: expected 0 or more, 1 or more"
            )
        arm = self.rig.kind == "ur"
        allowed = (
            ("joints", "flange", "camera", "grid", "dome", "calibration", "taught")
            if arm
            else ("positions", "steps", "taught")
        )
        for number, poses in enumerate(self.poses):
            if poses.given not in allowed:
                raise OptionError(
                    f"poses[{number}]: {poses.given} for a rig of kind {self.rig.kind},"
                    f" expected one of: {', '.join(allowed)}"
                )
        boards = {poses.calibration.board for poses in self.poses if poses.calibration is not None}
        if len(boards) > 1:
            raise OptionError(f"poses: boards {' and '.join(sorted(boards))}, expected one")
        if not arm and self.motion.move != "joints":
            raise OptionError("motion.move: linear is for arms, a gantry moves in lines anyway")

    @property
    def board(self) -> Board | None:
        """The calibration board that it looks at; None: it does not calibrate."""
        given = [poses.calibration.board for poses in self.poses if poses.calibration is not None]
        return Board.parse(given[0]) if given else None


def plain(value: Any) -> Any:
    """A value as JSON has it: dataclasses as mappings, tuples as lists, paths as text."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return str(value) if isinstance(value, Path) else value


def _above_zero(options: Any, *names: str) -> None:
    for name in names:
        if getattr(options, name) <= 0.0:
            raise OptionError(f"{name} {getattr(options, name)}: expected above 0")
