"""What every format is read into: frames with poses, and how their numbers are meant."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import Camera
from depthba.convert.reading import Axes, Direction, Quaternions, Reading
from depthba.errors import DatasetError
from depthba.words import count

if TYPE_CHECKING:
    from depthba.dataset import Dataset

Array = NDArray[np.float64]

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""T_opengl_opencv, and its inverse: y and z the other way round."""
_NEARLY_RIGID = 1e-2
"""How far from orthonormal a rotation in a file may be: some are written with three decimals."""


@dataclass(frozen=True)
class Convention:
    """How the poses in a file are meant."""

    axes: Axes = "opencv"
    direction: Direction = "camera-to-world"
    scale: float = 1.0
    """Metres per unit of translations."""
    quaternions: Quaternions = "xyzw"
    """Order in which the file has them; its poses were read as xyzw."""

    def applied(self, poses: Array) -> Array:
        """Return T_world_camera (N, 4, 4), m, OpenCV's axes, of poses (N, 4, 4) as in the file."""
        T = poses.copy()
        if self.quaternions == "wxyz":
            T = se3.from_quaternion(T[:, :3, 3], np.roll(se3.quaternion(T), -1, axis=-1))
        T[:, :3, 3] *= self.scale
        if self.direction == "world-to-camera":
            T = se3.inverse(T)
        return T @ FLIP if self.axes == "opengl" else T

    def undone(self, T_world_camera: Array) -> Array:
        """Return poses as a file of this convention has them: the inverse of `applied`."""
        T = T_world_camera @ FLIP if self.axes == "opengl" else T_world_camera.copy()
        if self.direction == "world-to-camera":
            T = se3.inverse(T)
        T[:, :3, 3] /= self.scale
        if self.quaternions == "wxyz":
            T = se3.from_quaternion(T[:, :3, 3], np.roll(se3.quaternion(T), 1, axis=-1))
        return T

    def asked(self, reading: Reading) -> Convention:
        """Return the convention with what the options say in place of what the format says."""
        return Convention(
            axes=reading.axes or self.axes,
            direction=reading.direction or self.direction,
            scale=reading.pose_scale or self.scale,
            quaternions=reading.quaternions or self.quaternions,
        )

    def __str__(self) -> str:
        """Return the convention in a few words."""
        scale = "" if self.scale == 1.0 else f", {self.scale:g} m per unit"
        order = "" if self.quaternions == "xyzw" else ", quaternions wxyz"
        return f"{self.axes} axes, {self.direction}{scale}{order}"


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """A frame as its source has it. Either ``depth`` or ``cloud`` is there."""

    name: str
    """Its file, for people."""
    stamp: float
    """Seconds."""
    pose: Array
    """(4, 4), by the recording's convention."""
    depth: Callable[[], Array] | None = None
    """Gives (height, width), m; 0 or NaN where nothing was measured."""
    cloud: Callable[[], Array] | None = None
    """Gives points (n, 3), m, sensor frame."""
    rgb: Callable[[], NDArray[np.uint8]] | None = None
    """Gives (height, width, 3), RGB, aligned to depth."""
    camera: Camera | None = None
    """Of the depth image."""


@dataclass(frozen=True, eq=False)
class Recording:
    """A source, read: what a dataset is made of. Images are loaded when asked for."""

    path: Path
    format: str
    frames: tuple[SourceFrame, ...]
    convention: Convention = Convention()
    depth_scale: float | None = None
    """Metres per unit of the depth images, as `--depth-scale` gives it; None: there are none."""
    floats: bool = False
    """Whether they hold floating-point numbers, which have no step to be kept in."""
    model: str = ""
    origin: bool = True
    """Clouds: whether the rays start at the origin of the sensor frame."""
    notes: tuple[str, ...] = ()
    """What people should know: what was left out, what was assumed."""

    @property
    def T_world_camera(self) -> Array:
        """(N, 4, 4), m, OpenCV's axes."""
        return self.convention.applied(self.poses)

    @property
    def poses(self) -> Array:
        """(N, 4, 4), by the convention."""
        return np.array([frame.pose for frame in self.frames]).reshape(-1, 4, 4)

    def ready(self, reading: Reading) -> Recording:
        """Return the recording by the conventions asked for, its poses checked and made rigid.

        Raises `DatasetError` where there is no frame, or a pose is none.
        """
        if not self.frames:
            raise DatasetError(f"{self.path}: no frame with a pose in it")
        frames = tuple(
            replace(frame, pose=rigid(frame.pose, f"{self.path}: pose of {frame.name}"))
            for frame in self.frames
        )
        return replace(self, frames=frames, convention=self.convention.asked(reading))


@dataclass(frozen=True)
class Format:
    """A format of other people: how to know it, to read it and to write it."""

    name: str
    title: str
    """What it is and what lies in the folder, in one line."""
    recognise: Callable[[Path], str]
    """Returns what in the source speaks for the format, or ""."""
    read: Callable[[Path, Reading], Recording] | None = None
    """Reads a source. `DatasetError` names the file and what was expected."""
    write: Callable[[Dataset, Array, Path], None] | None = None
    """Writes the frames of a dataset at poses T_world_camera (N, 4, 4) into a new folder."""
    generic: bool = False
    """Whether it is what is left where no other format is recognised."""


def rigid(T: Array, name: str) -> Array:
    """Return the rigid transform (4, 4) next to one of few decimals (polar decomposition).

    Raises `DatasetError` where it is none.
    """
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise DatasetError(f"{name} is not finite, expected a rigid transform")
    if not se3.is_rigid(T, _NEARLY_RIGID):
        worst = float(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max())
        raise DatasetError(
            f"{name} is no rigid transform: rotation off by {worst:.3g}, "
            f"determinant {np.linalg.det(T[:3, :3]):.3g}, last row {T[3].tolist()}"
        )
    if se3.is_rigid(T, 1e-12):
        return T
    U, _, Vt = np.linalg.svd(T[:3, :3])
    return se3.make(U @ Vt, T[:3, 3])


def left_out(names: Iterable[str], why: str) -> tuple[str, ...]:
    """Return a note that names what was left out, or none where nothing was."""
    gone = list(names)
    if not gone:
        return ()
    first = ", ".join(gone[:3]) + (", …" if len(gone) > 3 else "")
    return (f"{count(len(gone), 'frame')} left out: {why} ({first})",)
