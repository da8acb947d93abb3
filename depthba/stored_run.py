"""A run read back from its folder, each file checked."""

from __future__ import annotations

import io
import os
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from depthba import bounds, trajectory
from depthba.depth_map import DepthMap
from depthba.documents import parse_json, parse_yaml
from depthba.errors import DatasetError, RunError

Floats = NDArray[np.float64]

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
