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
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from depthba import durable, trajectory
from depthba.clouds import FrameCloud, inside, load_clouds, thin, transform
from depthba.dataset import Dataset
from depthba.depth_map import DepthMap
from depthba.errors import RunError
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
