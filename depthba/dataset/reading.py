"""Opening a dataset: everything but the images is read and checked at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from depthba.dataset.extras import read_calibration, read_markers
from depthba.dataset.faults import Faults
from depthba.dataset.header import read_header
from depthba.dataset.listing import Entry, join, pose_file, read_entries, read_poses
from depthba.dataset.model import Frame, Marker
from depthba.dataset.sensor import PoseNoise, Sensor
from depthba.errors import DatasetError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Dataset:
    """A dataset folder, opened. A sequence of frames; their images are loaded when asked for."""

    path: Path
    name: str
    sensor: Sensor
    map_frame: Literal["world", "auto"]
    """``world``: the depth map lies over the world's x-y plane. ``auto``: registration chooses."""
    seed: int | None
    pose_noise: PoseNoise | None
    """Believed accuracy of the measured poses, None where unknown."""
    T_flange_camera: Array | None
    """(4, 4), the hand-eye transform behind the measured poses, None where unknown."""
    header: dict[str, Any] = field(repr=False)
    """The whole dataset.json, unknown keys too."""
    frames: tuple[Frame, ...] = field(repr=False)
    warnings: tuple[str, ...] = ()
    """What was dropped while reading, one line each."""
    left_out: frozenset[int] = frozenset()
    """Ids of the frames in the folder that `subset` left out."""

    @staticmethod
    def open(path: str | Path) -> Dataset:
        """Open the dataset folder ``path``.

        Its metadata and poses are checked strictly, its images are not touched.

        Raises `DatasetError`, one line that names the file, the frame, the value and what was
        expected.
        """
        root = Path(path)
        faults = Faults(root)
        header = read_header(root, faults)
        assert header is not None  # strict faults raise
        entries, warnings = read_entries(root, header.sensor.kind, faults)
        poses, more = _poses(root, "measured", entries, faults)
        warnings += more
        for entry in entries:
            for stored in entry.files.values():
                if not (root / stored.path).is_file():
                    faults.add(
                        stored.path, entry.id, "no such file, expected it as frames.jsonl lists it"
                    )
        if (root / pose_file("true")).exists():
            trajectory = read_poses(root, "true", faults)
            assert trajectory is not None
            warnings += [f"{root / pose_file('true')}: {text}" for text in trajectory.warnings]
        if not entries:
            warnings.append(f"{root}: no frame in it")
        frames = []
        for entry, T_world_camera in zip(entries, poses, strict=True):
            T_world_camera.setflags(write=False)
            frames.append(
                Frame(
                    id=entry.id,
                    stamp=entry.stamp,
                    T_world_camera=T_world_camera,
                    sensor=header.sensor,
                    root=root,
                    files=entry.files,
                    joints=entry.joints,
                    T_base_flange=entry.T_base_flange,
                    record=entry.record,
                )
            )
        return Dataset(
            path=root,
            name=header.name,
            sensor=header.sensor,
            map_frame=header.map_frame,
            seed=header.seed,
            pose_noise=header.pose_noise,
            T_flange_camera=header.T_flange_camera,
            header=header.raw,
            frames=tuple(frames),
            warnings=tuple(warnings),
        )

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        """Iterate over the frames in the order of their ids."""
        return iter(self.frames)

    def __getitem__(self, index: int) -> Frame:
        """Return the frame at a position, which need not be its id."""
        return self.frames[index]

    def subset(self, rows: Sequence[int]) -> Dataset:
        """Return the dataset with the frames at these positions alone, in their order.

        Raises `DatasetError` where there is no frame at a position.
        """
        for row in rows:
            if not 0 <= row < len(self.frames):
                raise DatasetError(
                    f"{self.path}: no frame at position {row}, expected 0 to {len(self.frames) - 1}"
                )
        kept = tuple(self.frames[row] for row in sorted(set(rows)))
        gone = {frame.id for frame in self.frames} - {frame.id for frame in kept}
        return replace(self, frames=kept, left_out=self.left_out | gone)

    @property
    def ids(self) -> tuple[int, ...]:
        """The frames' ids."""
        return tuple(frame.id for frame in self.frames)

    @property
    def stamps(self) -> Array:
        """(N,), seconds."""
        return np.array([frame.stamp for frame in self.frames], dtype=np.float64)

    @property
    def T_world_camera_measured(self) -> Array:
        """(N, 4, 4), as measured: where a registration begins."""
        return np.array([frame.T_world_camera for frame in self.frames]).reshape(-1, 4, 4)

    @property
    def T_world_camera_true(self) -> Array | None:
        """(N, 4, 4), the truth, or None where it is not known. `DatasetError`: a frame lacks it."""
        if not (self.path / pose_file("true")).exists():
            return None
        return self.poses("true")

    def poses(self, name: str) -> Array:
        """Return the poses (N, 4, 4) of poses_<name>.txt, joined to the frames by stamp.

        Raises `DatasetError` where there is no such file, it is malformed, or a frame has no pose.
        """
        if not (self.path / pose_file(name)).exists() or Path(name).name != name:
            here = sorted(p.name[6:-4] for p in self.path.glob(pose_file("*")))
            raise DatasetError(f"{self.path}: no poses {name!r}, expected one of {', '.join(here)}")
        return _poses(self.path, name, self.frames, Faults(self.path))[0]

    def markers(self) -> tuple[Marker, ...]:
        """Return the markers with known position; empty where there is no markers.json."""
        found = read_markers(self.path, {*self.ids, *self.left_out}, Faults(self.path))
        return tuple(
            replace(m, observations=tuple(o for o in m.observations if o[0] not in self.left_out))
            for m in found
        )

    def calibration(self) -> dict[str, Any] | None:
        """Return calibration.json, checked, or None where there is none."""
        return read_calibration(self.path, Faults(self.path))


def _poses(
    root: Path, name: str, frames: Sequence[Entry | Frame], faults: Faults
) -> tuple[Array, list[str]]:
    """Return the frames' poses (N, 4, 4) and warnings; ``faults`` is strict."""
    trajectory = read_poses(root, name, faults)
    assert trajectory is not None
    warnings = [f"{root / pose_file(name)}: {text}" for text in trajectory.warnings]
    return join(frames, trajectory, name, faults), warnings
