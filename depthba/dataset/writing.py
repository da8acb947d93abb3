"""Writing a dataset so that a crash at any instant loses nothing that was committed.

A frame's files come first, then its lines in poses_*.txt, and last its line in frames.jsonl, which
is the commit; each is on disk before the next begins.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import durable, ply, se3
from depthba.dataset import extras, fields, images, listing
from depthba.dataset import header as header_file
from depthba.dataset.faults import Faults, MalformedError
from depthba.dataset.listing import Entry, pose_file
from depthba.dataset.model import Marker
from depthba.dataset.resuming import recover
from depthba.dataset.sensor import Sensor
from depthba.errors import DatasetError
from depthba.trajectory import tum_line

_OWN_KEYS = {"id", "stamp", "depth", "rgb", "cloud", "sha256", "joints", "T_base_flange"}

POSE_COMMENT = "# T_world_camera: stamp tx ty tz qx qy qz qw"


class DatasetWriter:
    """Writes frames one by one. Make it with `create` or `resume`; there is nothing to close."""

    def __init__(
        self, path: Path, sensor: Sensor, entries: Sequence[Entry], truth: bool | None
    ) -> None:
        """Use `create` or `resume` instead: they see that ``path`` is as the arguments say."""
        self.path = path
        self.sensor = sensor
        self.warnings: tuple[str, ...] = ()
        """What `resume` dropped, one line each."""
        self._ids = [entry.id for entry in entries]
        self._stamps = [entry.stamp for entry in entries]
        self._paths = {stored.path for entry in entries for stored in entry.files.values()}
        self._truth = truth
        self._size = (path / listing.FILE).stat().st_size
        self._failed = False

    @staticmethod
    def create(path: str | Path, header: Mapping[str, Any]) -> DatasetWriter:
        """Begin a dataset in ``path``, which must not exist or be empty.

        ``header`` is the object of dataset.json; ``format`` and ``version`` may be left out. Raises
        `DatasetError` for a header that could not be read back, and where something is in the way.
        """
        root = Path(path)
        try:
            text = json.dumps(
                {"format": header_file.FORMAT, "version": header_file.VERSION, **header},
                allow_nan=False,
            )
        except (TypeError, ValueError) as error:
            raise DatasetError(f"{root / header_file.FILE}: header is no JSON: {error}") from error
        raw = fields.parse(text)
        checked = header_file.parse_header(raw, Faults(root), default_name=root.name)
        assert checked is not None  # strict faults raise
        with _disk(root):
            if root.exists() and not root.is_dir():
                raise DatasetError(f"{root}: not a folder, expected none or an empty one")
            durable.make_folder(root)
            if not _unused(root):
                raise DatasetError(f"{root}: not empty, expected no folder or an empty one")
            # These two are empty, so that from dataset.json on the folder is a whole dataset.
            durable.write_text(root / listing.FILE, "")
            durable.write_text(root / pose_file("measured"), POSE_COMMENT + "\n")
            for name in ("cloud",) if checked.sensor.kind == "cloud" else ("depth",):
                durable.make_folder(root / name)
            durable.write_json(root / header_file.FILE, raw)
        return DatasetWriter(root, checked.sensor, [], None)

    @staticmethod
    def resume(path: str | Path) -> DatasetWriter:
        """Go on with a dataset after a stop or a crash.

        Keeps the longest prefix of frames whose files are whole and that have their poses, sets
        what is listed behind it aside in a folder ``dropped-<n>``, and says so in ``warnings``.
        Raises `DatasetError` for a dataset that is wrong in a way that no crash explains.
        """
        root = Path(path)
        header = header_file.read_header(root, Faults(root))
        assert header is not None  # strict faults raise
        with _disk(root):
            entries, truth, warnings = recover(root, header.sensor.kind, POSE_COMMENT)
            writer = DatasetWriter(root, header.sensor, entries, truth)
        writer.warnings = tuple(warnings)
        return writer

    def __len__(self) -> int:
        """Return the number of committed frames."""
        return len(self._ids)

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the committed frames."""
        return tuple(self._ids)

    @property
    def stamps(self) -> tuple[float, ...]:
        """Stamps of the committed frames, seconds."""
        return tuple(self._stamps)

    def add_frame(
        self,
        *,
        stamp: float,
        T_world_camera: ArrayLike,
        depth: ArrayLike | None = None,
        cloud: ArrayLike | None = None,
        rgb: ArrayLike | None = None,
        T_world_camera_true: ArrayLike | None = None,
        joints: ArrayLike | None = None,
        T_base_flange: ArrayLike | None = None,
        notes: Mapping[str, Any] | None = None,
    ) -> int:
        """Commit one frame and return its id; it is on disk when this returns.

        Give ``depth`` (height, width), metres, NaN or 0 where nothing was measured, with ``rgb``
        (height, width, 3) uint8 if there is one; or ``cloud`` (n, 3), metres, in the sensor frame,
        of which rows with NaN are left out. Poses are (4, 4). Truth comes with all frames or none.
        ``notes`` are further keys of the frame's line, of JSON values, which `Frame.record` gives.

        Raises `DatasetError` for what could not be read back, before anything is written; and where
        the disk fails, after which only `resume` goes on.
        """
        frame = self._next_id()
        with self._reported(frame):
            stamp = fields.number(float(stamp), "stamp")
            if any(abs(stamp - other) <= 2 * listing.STAMP_TOLERANCE for other in self._stamps):
                raise MalformedError(f"stamp {stamp:.9f} is taken, expected one of its own")
            poses = {"measured": _rigid(T_world_camera, "T_world_camera")}
            if T_world_camera_true is not None:
                poses["true"] = _rigid(T_world_camera_true, "T_world_camera_true")
            truth = T_world_camera_true is not None
            if self._truth is not None and truth != self._truth:
                raise MalformedError(
                    f"T_world_camera_true is {'given' if truth else 'missing'},"
                    " expected it for all frames or none"
                )
            record: dict[str, Any] = {"id": frame, "stamp": stamp}
            files = self._encode(depth, cloud, rgb)
            more: dict[str, Any] = dict(notes or {})
            if taken := sorted(_OWN_KEYS & more.keys()):
                raise MalformedError(f"notes has the key {taken[0]!r}, which the format has itself")
            if joints is not None:
                values = np.asarray(joints, dtype=np.float64).tolist()
                more["joints"] = list(fields.numbers(values, "joints"))
            if T_base_flange is not None:
                more["T_base_flange"] = _rigid(T_base_flange, "T_base_flange").tolist()
        self._check_alone()
        try:
            with _disk(self.path):
                record |= {name: _file(name, frame) for name in files}
                record["sha256"] = {}
                for name, data in files.items():
                    target = self.path / _file(name, frame)
                    if not target.parent.exists():
                        durable.make_folder(target.parent)
                    record["sha256"][name] = durable.write_bytes(target, data)
                self._append_poses(stamp, poses)
                line = json.dumps(record | more, allow_nan=False)
                durable.append_line(self.path / listing.FILE, line)
        except BaseException:
            self._failed = True
            raise
        self._size += len(line.encode()) + 1
        self._ids.append(frame)
        self._stamps.append(stamp)
        self._paths |= {_file(name, frame) for name in files}
        self._truth = truth
        return frame

    def write_markers(self, markers: Sequence[Marker]) -> None:
        """Write markers.json, over one that is there. `DatasetError`: a frame is not committed."""
        try:
            raw = extras.markers_json(markers, set(self._ids))
        except MalformedError as error:
            raise DatasetError(f"{self.path / extras.MARKERS}: {error}") from error
        with _disk(self.path):
            durable.write_json(self.path / extras.MARKERS, raw)

    def write_calibration(self, calibration: Mapping[str, Any]) -> None:
        """Write calibration.json, over one that is there; transforms may be arrays (4, 4).

        Raises `DatasetError` for what could not be read back.
        """
        try:
            raw = extras.calibration_json(calibration)
        except MalformedError as error:
            raise DatasetError(f"{self.path / extras.CALIBRATION}: {error}") from error
        with _disk(self.path):
            durable.write_json(self.path / extras.CALIBRATION, raw)

    def _encode(
        self, depth: ArrayLike | None, cloud: ArrayLike | None, rgb: ArrayLike | None
    ) -> dict[str, bytes]:
        given = [n for n, v in (("depth", depth), ("cloud", cloud)) if v is not None]
        if given != [self.sensor.kind]:
            raise MalformedError(
                f"{' and '.join(given) or 'nothing'} given,"
                f" expected {self.sensor.kind} as sensor.kind says"
            )
        if cloud is not None:
            if rgb is not None:
                raise MalformedError("rgb given with a cloud, expected it with depth only")
            return {"cloud": _encode_cloud(cloud)}
        assert depth is not None  # sensor.kind is depth
        files = {"depth": images.encode_depth(depth, self.sensor)}
        if rgb is not None:
            files["rgb"] = images.encode_rgb(rgb, self.sensor)
        return files

    def _append_poses(self, stamp: float, poses: Mapping[str, NDArray[np.float64]]) -> None:
        for name, T_world_camera in poses.items():
            file = self.path / pose_file(name)
            if not file.exists():
                durable.write_text(file, POSE_COMMENT + "\n")
            durable.append_line(file, tum_line(stamp, T_world_camera))

    def _next_id(self) -> int:
        """Never one whose files a committed frame has, even where another program named them."""
        frame = self._ids[-1] + 1 if self._ids else 0
        while self._paths & {_file(name, frame) for name in ("depth", "rgb", "cloud")}:
            frame += 1
        return frame

    def _check_alone(self) -> None:
        if self._failed:
            raise DatasetError(
                f"{self.path}: an earlier write failed, expected DatasetWriter.resume"
            )
        with _disk(self.path):
            size = (self.path / listing.FILE).stat().st_size
        if size != self._size:
            raise DatasetError(
                f"{self.path / listing.FILE}: {size} bytes, expected {self._size}:"
                " another program writes to it"
            )

    @contextlib.contextmanager
    def _reported(self, frame: int) -> Iterator[None]:
        try:
            yield
        except MalformedError as error:
            raise DatasetError(f"{self.path}: frame {frame}: {error}") from error


def _file(name: str, frame: int) -> str:
    return f"{name}/{frame:06d}.{'ply' if name == 'cloud' else 'png'}"


def _rigid(T: ArrayLike, name: str) -> NDArray[np.float64]:
    T = np.asarray(T, dtype=np.float64)
    if not se3.is_rigid(T) or T.shape != (4, 4):
        raise MalformedError(
            f"{name} is {fields.shown(T.tolist())}, expected a rigid transform (4, 4)"
        )
    return T


def _encode_cloud(cloud: ArrayLike) -> bytes:
    points = np.asarray(cloud, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MalformedError(f"cloud of shape {points.shape}, expected (n, 3)")
    points = points[~np.isnan(points).any(axis=1)]
    if (np.abs(points) > np.finfo(np.float32).max).any():
        raise MalformedError(
            "cloud has a coordinate that does not fit float32, expected metres or NaN"
        )
    return ply.ply_bytes(points)


def _unused(root: Path) -> bool:
    """Whether there is nothing in the folder but what a crash during `create` leaves."""
    if (root / header_file.FILE).exists():
        return False
    for entry in root.iterdir():
        leftover = entry.name in ("depth", "cloud") and entry.is_dir() and not any(entry.iterdir())
        leftover |= entry.name == listing.FILE and entry.stat().st_size == 0
        leftover |= (
            entry.name == pose_file("measured") and entry.stat().st_size <= len(POSE_COMMENT) + 1
        )
        leftover |= entry.name.startswith(".") and entry.name.endswith(durable.PART)
        if not leftover:
            return False
    return True


@contextlib.contextmanager
def _disk(root: Path) -> Iterator[None]:
    """Turn what the disk refuses into a known error."""
    try:
        yield
    except OSError as error:
        where = error.filename or root
        raise DatasetError(
            f"{where}: {error.strerror or error}, expected to be able to write there"
        ) from error
