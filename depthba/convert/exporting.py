"""From a dataset or a run to files of other formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import trajectory
from depthba.convert import registry
from depthba.convert.pairing import by_stamp
from depthba.convert.pose_files import Poses
from depthba.convert.recording import Format
from depthba.convert.results import surfaces, trajectories
from depthba.convert.results.outcome import Outcome, ResultFormat
from depthba.dataset import Dataset
from depthba.errors import OptionError

Array = NDArray[np.float64]

RESULTS = (*trajectories.FORMATS, *surfaces.FORMATS)
OURS = "depthba"


def is_run(path: Path) -> bool:
    """Tell whether a folder is a run of depthba, whole or not."""
    return (path / "result.json").is_file()


def target(dst: Path, to: str | None) -> Format | ResultFormat | None:
    """Return what is to be written; None: a dataset of depthba.

    A name that is both (kitti, a folder of frames or a file of poses) is told by the destination:
    a file has a suffix.

    Raises:
        OptionError: no format of that name, or none for that suffix.

    """
    suffix = dst.suffix.lower()
    if to == OURS or (to is None and not suffix):
        return None
    if to is None:
        found = [r for r in RESULTS if suffix in r.suffixes]
        if not found:
            known = " ".join(sorted({s for r in RESULTS for s in r.suffixes}))
            raise OptionError(f"{dst}: suffix {suffix!r}, expected one of {known}, or --to NAME")
        return found[0]
    results = [r for r in RESULTS if r.name == to]
    folders = [f for f in registry.formats() if f.name == to and f.write is not None]
    if results and (suffix or not folders):
        return results[0]
    if folders:
        return folders[0]
    writable = [f.name for f in registry.formats() if f.write is not None]
    names = ", ".join(dict.fromkeys([OURS, *writable, *(r.name for r in RESULTS)]))
    raise OptionError(f"--to {to}: is not written; choose from: {names}")


def poses_of(dataset: Dataset, which: str | None, max_gap: float) -> Array:
    """Return the poses (N, 4, 4) of a dataset's frames: measured, true, or those of a TUM file."""
    if which is None or which == "measured":
        return dataset.T_world_camera_measured
    if Path(which).is_file():
        stamps, T = trajectory.read_tum(which)
        names = [f"frame {frame.id}" for frame in dataset]
        paired, _ = by_stamp(names, dataset.stamps, Poses(Path(which), T, stamps), max_gap)
        if len(paired) != len(dataset):
            there = {k for k, _, _ in paired}
            missing = next(name for k, name in enumerate(names) if k not in there)
            raise OptionError(f"--poses {which}: no pose for {missing} of {dataset.path}")
        return np.array([T for _, _, T in paired])
    return dataset.poses(which)


def write(outcome: Outcome, kind: Format | ResultFormat, dst: Path) -> None:
    """Write an outcome.

    Raises:
        DepthbaError: something is in the way, or the outcome has not what the format holds.

    """
    if isinstance(kind, ResultFormat):
        kind.write(outcome, dst)
        return
    assert kind.write is not None and outcome.dataset is not None
    kind.write(outcome.dataset(), outcome.T_world_camera, dst)
