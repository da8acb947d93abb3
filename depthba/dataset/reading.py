"""Opening a dataset: everything but the images is read and checked at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from depthba.dataset.choosing import as_stored, crop, map_frame, masked, merge
from depthba.dataset.cutting import Bounds, Roi
from depthba.dataset.extras import read_calibration, read_markers
from depthba.dataset.faults import Faults
from depthba.dataset.header import FILE, read_header
from depthba.dataset.listing import Entry, join, pose_file, read_entries, read_poses
from depthba.dataset.model import Frame, Marker
from depthba.dataset.saving import save
from depthba.dataset.sensor import PoseNoise, Sensor
from depthba.errors import DatasetError, OptionError

Array = NDArray[np.float64]


def is_dataset(path: str | Path) -> bool:
    """Tell whether a dataset was begun in a folder; whole or not."""
    return (Path(path) / FILE).is_file()


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

    def crop(
        self,
        roi: Roi | None = None,
        *,
        heights: Bounds | None = None,
        depths: Bounds | None = None,
    ) -> Dataset:
        """Return the dataset with what lies outside left out of its frames as they are loaded.

        Args:
            roi: xmin xmax ymin ymax zmin zmax in the map frame, m, at the measured poses.
            heights: lowest and highest z in the map frame, m; the same as the end of ``roi``.
            depths: least and greatest z in the sensor frame, m.

        Raises:
            OptionError: a lower bound is not below its upper bound.

        """
        return crop(self, roi, heights=heights, depths=depths)

    def masked(self, mask: NDArray[Any] | str | Path) -> Dataset:
        """Return the dataset with the pixels alone that a mask has as not 0.

        Args:
            mask: (height, width); or an image file; or a folder of one image a frame, each named as
                the frame's depth image. For depth images only.

        Raises:
            DatasetError: a mask is missing, no image, or not of the sensor's size.

        """
        return masked(self, mask)

    def subsample(self, every: int) -> Dataset:
        """Return the dataset with every ``every``-th frame alone, from the first on."""
        if every < 1:
            raise OptionError(f"every is {every}, expected 1 or more")
        return self.subset(range(0, len(self), every))

    @staticmethod
    def merge(datasets: Sequence[Dataset], name: str = "") -> Dataset:
        """Return one dataset with the frames of several, whose poses are in one world.

        Frames are numbered anew. Where stamps meet, those of a later dataset are shifted, all
        by the same. Files stay where they are; `save` writes the whole into one folder.

        Raises:
            DatasetError: none is given, or their sensors differ.

        """
        return merge(datasets, name)

    def save(self, path: str | Path) -> Dataset:
        """Write the dataset as it stands, cuts and all, into a new folder; return that, opened.

        Raises:
            DatasetError: something is in the way, or a file of a frame is damaged.

        """
        return save(self, Path(path))

    def T_map_world(self) -> Array:
        """Return (4, 4), the map frame that a registration from the measured poses takes."""
        return map_frame(self)

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
        roots = {self.path, *(frame.root for frame in self.frames)}
        if not all((root / pose_file("true")).exists() for root in roots):
            return None
        return self.poses("true")

    def poses(self, name: str) -> Array:
        """Return the poses (N, 4, 4) of poses_<name>.txt, joined to the frames by stamp.

        Raises `DatasetError` where there is no such file, it is malformed, or a frame has no pose.
        """
        out = np.empty((len(self.frames), 4, 4))
        for root, rows in self._roots().items():
            if not (root / pose_file(name)).exists() or Path(name).name != name:
                here = sorted(p.name[6:-4] for p in root.glob(pose_file("*")))
                raise DatasetError(f"{root}: no poses {name!r}, expected one of {', '.join(here)}")
            stored = [as_stored(self.frames[row]) for row in rows]
            out[rows] = _poses(root, name, stored, Faults(root))[0]
        return out

    def markers(self) -> tuple[Marker, ...]:
        """Return the markers with known position; empty where there is no markers.json."""
        merged: dict[str, Marker] = {}
        for root, rows in self._roots().items():
            new_id = {as_stored(self.frames[row]).id: self.frames[row].id for row in rows}
            listed = {*new_id, *self.left_out} if root == self.path else _listed(root)
            for marker in read_markers(root, listed, Faults(root)):
                seen = tuple((new_id[i], p) for i, p in marker.observations if i in new_id)
                before = merged[marker.name].observations if marker.name in merged else ()
                merged[marker.name] = replace(marker, observations=before + seen)
        return tuple(merged.values())

    def _roots(self) -> dict[Path, list[int]]:
        """Return the folders that the frames lie in, with the positions of the frames."""
        roots: dict[Path, list[int]] = {} if self.frames else {self.path: []}
        for row, frame in enumerate(self.frames):
            roots.setdefault(frame.root, []).append(row)
        return roots

    def calibration(self) -> dict[str, Any] | None:
        """Return calibration.json, checked, or None where there is none."""
        return read_calibration(self.path, Faults(self.path))


def _listed(root: Path) -> set[int]:
    """Return the ids of all frames in a folder."""
    return {entry.id for entry in read_entries(root, None, Faults(root))[0]}


def _poses(
    root: Path, name: str, frames: Sequence[Entry | Frame], faults: Faults
) -> tuple[Array, list[str]]:
    """Return the frames' poses (N, 4, 4) and warnings; ``faults`` is strict."""
    trajectory = read_poses(root, name, faults)
    assert trajectory is not None
    warnings = [f"{root / pose_file(name)}: {text}" for text in trajectory.warnings]
    return join(frames, trajectory, name, faults), warnings
