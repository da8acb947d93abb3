"""A run on disk: what a registration leaves behind, each file whole or not at all.

The plain files are the archive; the recording that may stand beside them is for looking.
"""

from __future__ import annotations

import dataclasses
import io
import os
import platform
import time
import zipfile
import zlib
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from depthba import bounds, durable, trajectory
from depthba.clouds import FrameCloud, inside, load_clouds, thin, transform
from depthba.dataset import Dataset
from depthba.depth_map import DepthMap
from depthba.documents import parse_json, parse_yaml
from depthba.errors import DatasetError, RunError
from depthba.options import Options
from depthba.ply import write_ply
from depthba.result import Iteration, Result

Floats = NDArray[np.float64]

LOGS = Path("logs")
LATEST = "latest"
CLOUD_POINTS = 1_500_000
"""Most points in cloud.ply, 15 bytes each; where there are more they are thinned."""


def default_path(name: str, logs: Path = LOGS) -> Path:
    """Return a new folder name in ``logs`` for a run of the dataset ``name``, by the local time."""
    stem = "".join(c if c.isalnum() or c in "-_." else "-" for c in name).strip(".") or "run"
    first = path = logs / f"{stem}-{time.strftime('%Y%m%d-%H%M%S')}"
    again = 1
    while path.exists():  # two runs within one second
        again += 1
        path = first.with_name(f"{first.name}-{again}")
    return path


class RunFolder:
    """The folder that a registration writes into."""

    def __init__(self, path: Path) -> None:
        """Take ``path`` as it is; use `create` to claim a folder."""
        self.path = path

    @classmethod
    def create(cls, path: str | os.PathLike[str], overwrite: bool = False) -> RunFolder:
        """Claim a folder for a run.

        Args:
            path: must not exist or be empty.
            overwrite: allow an earlier run there: its files are replaced one by one.

        Raises:
            RunError: the folder is in the way.

        """
        path = Path(path)
        if path.exists() and not path.is_dir():
            raise RunError(f"{path}: is a file, expected a folder for the run")
        if path.is_dir() and not overwrite and any(path.iterdir()):
            raise RunError(f"{path}: is not empty, expected a new folder, or --overwrite")
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"{path}: cannot make the folder: {error.strerror}") from error
        if overwrite:
            # these speak of the earlier run, or are what a crash left of it
            stale = [path / name for name in ("metrics.json", "report.md", "run.rrd")]
            for file in [*stale, *path.glob(f".*{durable.PART}")]:
                file.unlink(missing_ok=True)
        return cls(path)

    def write(self, result: Result, options: Options, dataset: Dataset) -> None:
        """Write every file of the run, each whole, result.json last; then point logs/latest here.

        Raises:
            DatasetError: the frames cannot be read again for the cloud and the picture.

        """
        from depthba.picture import map_picture  # matplotlib takes a second to import

        clouds = load_clouds(dataset)
        config = yaml.safe_dump(_plain(dataclasses.asdict(options)), sort_keys=False)
        durable.write_text(self.path / "config.yaml", config)
        trajectory.write_tum(
            self.path / "poses.txt", np.array(result.stamps), result.T_world_camera, "estimate"
        )
        trajectory.write_tum(
            self.path / "poses_start.txt",
            np.array(result.stamps),
            result.T_world_camera_start,
            "where the registration began",
        )
        durable.write_bytes(self.path / "covariance.npz", covariance_bytes(result.covariance))
        durable.write_bytes(self.path / "map.npz", map_bytes(result.depth_map))
        durable.write_bytes(self.path / "map_start.npz", map_bytes(result.depth_map_start))
        points, colours = merged_cloud(result, options, clouds)
        write_ply(self.path / "cloud.ply", points, colours)
        map_picture(result, dataset, self.path / "map.png", options=options, clouds=clouds)
        durable.write_json(self.path / "result.json", summary(result, options, dataset))
        link_latest(self.path)


def link_latest(run: Path) -> None:
    """Point ``logs/latest`` at ``run`` if it lies in a folder logs, at any depth; else do nothing.

    Where links are not to be had, there is none.
    """
    run = run.resolve()
    logs = next((p for p in run.parents if p.name == LOGS.name), None)
    if logs is None:
        return
    temporary = logs / f".{LATEST}.{os.getpid()}"
    try:
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(run.relative_to(logs), target_is_directory=True)
        temporary.replace(logs / LATEST)
    except OSError:  # a file system without links, or a folder of that name: a convenience less
        temporary.unlink(missing_ok=True)


def npz_bytes(arrays: dict[str, NDArray[Any]]) -> bytes:
    """Return a compressed npz whose bytes depend on nothing but the arrays."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            body = io.BytesIO()
            np.lib.format.write_array(body, np.asarray(array, order="C"), allow_pickle=False)
            archive.writestr(entry, body.getvalue(), compresslevel=1)
    return out.getvalue()


def map_bytes(depth_map: DepthMap) -> bytes:
    """Return map.npz: heights, origin, spacing, T_map_world, count, sigma."""
    return npz_bytes(
        {
            "heights": np.asarray(depth_map.heights, dtype=np.float64),
            "origin": np.asarray(depth_map.origin, dtype=np.float64),
            "spacing": np.asarray(depth_map.spacing, dtype=np.float64),
            "T_map_world": np.asarray(depth_map.T_map_world, dtype=np.float64),
            "count": np.asarray(depth_map.count, dtype=np.int64),
            "sigma": np.asarray(depth_map.sigma, dtype=np.float64),
        }
    )


def covariance_bytes(full: Floats) -> bytes:
    """Return covariance.npz: full (6N, 6N) and frames (N, 6, 6), its diagonal blocks."""
    n = len(full) // 6
    frames = full.reshape(n, 6, n, 6)[np.arange(n), :, np.arange(n), :]
    return npz_bytes({"frames": frames, "full": full})


def merged_cloud(
    result: Result, options: Options, clouds: tuple[FrameCloud, ...]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Merge the frames at their estimated poses, thinned to `CLOUD_POINTS`.

    Returns:
        (n, 3) points in world coordinates, m, and (n, 3) colours: the camera's, else by height.

    """
    T_map_world = result.depth_map.T_map_world
    coloured = any(c.colours is not None for c in clouds)
    parts = []
    for cloud, T in zip(clouds, result.T_world_camera, strict=True):
        p = transform(T, cloud.points)
        keep = inside(transform(T_map_world, p), options.roi)
        grey = np.full((len(p), 3), 128, np.uint8)
        colours = grey if cloud.colours is None else cloud.colours
        parts.append(np.column_stack([p, colours])[keep])
    rows = np.concatenate(parts)
    voxel = 0.5 * result.depth_map.spacing
    while len(rows) > CLOUD_POINTS:
        rows = thin(rows, voxel)
        voxel *= 1.25
    points, tints = rows[:, :3], np.rint(rows[:, 3:]).astype(np.uint8)
    if not coloured:
        from depthba.picture import height_colours

        tints = height_colours(transform(T_map_world, points)[:, 2])
    return points.astype(np.float32), tints


def summary(result: Result, options: Options, dataset: Dataset) -> dict[str, Any]:
    """Return what result.json holds: lengths in metres, angles in radians, times in seconds."""
    ny, nx = result.depth_map.shape
    out = {
        "format": "depthba-run",
        "version": 1,
        "name": dataset.name,
        "status": result.status,
        "trusted": result.trusted,
        "reason": result.reason,
        "iterations": len(result.history),
        "seconds": result.seconds,
        "sigma": result.sigma,
        "inflation": result.inflation,
        "fixed_pattern": result.fixed_pattern,
        "refused_pattern": result.refused_pattern,
        "dataset": {
            "path": str(Path(dataset.path).resolve()),
            "name": dataset.name,
            "frames": len(result.frame_ids),
            "seed": dataset.seed,
            "map_frame": dataset.map_frame,
            "truth": dataset.T_world_camera_true is not None,
        },
        "options": dataclasses.asdict(options),
        "map": {"spacing": result.depth_map.spacing, "nx": nx, "ny": ny},
        "weak": [dataclasses.asdict(w) for w in result.weak],
        "frames": [dataclasses.asdict(f) for f in result.frames],
        "overlap": result.overlap,
        "history": [history_scalars(i) for i in result.history],
        "versions": versions(),
    }
    plain = _plain(out)
    assert isinstance(plain, dict)
    return plain


def history_scalars(iteration: Iteration) -> dict[str, Any]:
    """Return the scalars of one iteration by name, leaving out poses and map."""
    names = [f.name for f in dataclasses.fields(iteration)]
    return {n: getattr(iteration, n) for n in names if n not in ("T_world_camera", "depth_map")}


def versions() -> dict[str, str]:
    """Return the versions of what a result depends on; absent packages are left out."""
    out = {"python": platform.python_version(), "machine": platform.machine()}
    for package in ("depthba", "numpy", "scipy", "numba"):
        try:
            out[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return out


def _plain(value: Any) -> Any:
    """Turn arrays, tuples and NumPy scalars into what JSON and YAML hold; NaN into None."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


BROKEN = (OSError, KeyError, TypeError, ValueError, yaml.YAMLError, DatasetError)
"""What reading the files of a broken run raises."""


@dataclass(frozen=True)
class Run:
    """A run as its folder holds it."""

    path: Path
    name: str
    result: dict[str, Any]
    """result.json."""
    config: dict[str, Any]
    """config.yaml, the options in force."""
    stamps: Floats
    """(N,), seconds."""
    T_world_camera: Floats
    """(N, 4, 4), estimated."""
    T_world_camera_start: Floats | None
    """(N, 4, 4), where the registration began; None where the folder does not tell."""
    covariance: Floats | None
    """(6N, 6N), see `depthba.result.Result`; None where there is none."""
    depth_map: DepthMap
    depth_map_start: DepthMap | None
    """The map that the start poses give; None where the folder does not tell."""
    dataset_path: Path
    """Where the dataset stood when the run was made."""

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Run:
        """Read a run folder.

        Raises:
            RunError: the folder or one of its files is missing or not readable.

        """
        path = Path(path)
        if not path.is_dir():
            raise RunError(f"{path}: no such run folder, expected one that register wrote")
        result = read_result(path)
        try:
            config = parse_yaml((path / "config.yaml").read_text(encoding="utf-8"))
            if not isinstance(config, dict):
                raise ValueError(f"config.yaml holds {type(config).__name__}, expected options")
            stamps, T_world_camera = trajectory.read_tum(path / "poses.txt")[:2]
            start = path / "poses_start.txt"
            T_start = trajectory.read_tum(start)[1] if start.exists() else None
            depth_map = read_map(path / "map.npz")
            map_start = path / "map_start.npz"
            covariance = None
            if (path / "covariance.npz").exists():
                covariance = read_arrays(path / "covariance.npz")["full"]
                if covariance.shape != (6 * len(stamps),) * 2:
                    raise ValueError(
                        f"covariance.npz: full of shape {covariance.shape} for {len(stamps)} poses"
                    )
            return cls(
                path=path,
                name=str(result["name"]),
                result=result,
                config=config,
                stamps=stamps,
                T_world_camera=T_world_camera,
                T_world_camera_start=T_start,
                covariance=covariance,
                depth_map=depth_map,
                depth_map_start=read_map(map_start) if map_start.exists() else None,
                dataset_path=Path(result["dataset"]["path"]),
            )
        except BROKEN as error:
            told = f"{type(error).__name__} {error}" if isinstance(error, KeyError) else error
            raise RunError(f"{path}: not a whole run folder: {told}") from error


def read_result(path: Path) -> dict[str, Any]:
    """Read result.json of a run folder; it is written last, so without it there is no run.

    Raises:
        RunError: it is missing or not one of ours.

    """
    file = path / "result.json"
    try:
        result = parse_json(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RunError(
            f"{file}: missing, expected a run, as `depthba register DATASET --out RUN` leaves it"
        ) from None
    except (OSError, ValueError) as error:
        raise RunError(f"{file}: not readable: {error}") from error
    if not isinstance(result, dict) or result.get("format") != "depthba-run":
        raise RunError(f"{file}: format is not 'depthba-run'")
    if result.get("version") != 1:
        raise RunError(f"{file}: version {result.get('version')!r}, expected 1")
    return result


def read_map(path: Path) -> DepthMap:
    """Read a map.npz. Raises one of `BROKEN`."""
    arrays = read_arrays(path)
    shape = arrays["heights"].shape
    expected = {"heights": shape, "count": shape, "sigma": shape, "T_map_world": (4, 4)}
    expected |= {"origin": (2,), "spacing": ()}
    for name, wanted in expected.items():
        array = arrays[name]
        if array.shape != wanted or array.dtype.kind not in "fiu" or len(shape) != 2:
            raise ValueError(f"{path.name}: {name} of shape {array.shape}, {array.dtype}")
    x, y = arrays["origin"]
    return DepthMap(
        heights=arrays["heights"],
        origin=(float(x), float(y)),
        spacing=float(arrays["spacing"]),
        T_map_world=arrays["T_map_world"],
        count=arrays["count"],
        sigma=arrays["sigma"],
    )


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of an npz file, which must not be larger than it could be worth.

    Raises:
        ValueError: it is none, or its arrays are larger than `depthba.bounds` allows.

    """
    data = path.read_bytes()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            total = sum(entry.file_size for entry in entries)
            if total > bounds.SPARE // 2 + 2 * len(data):
                raise ValueError(f"{total} bytes packed into {len(data)}")
            return {
                entry.filename.removesuffix(".npy"): bounds.read_array(archive.read(entry))
                for entry in entries
            }
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError) as error:
        raise ValueError(f"{path.name}: {error}, expected an archive of arrays") from error
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error
