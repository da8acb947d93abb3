"""Verifying a dataset: every fault at once, for `depthba doctor`."""

from __future__ import annotations

from pathlib import Path

from depthba.dataset import loading
from depthba.dataset.extras import read_calibration, read_markers
from depthba.dataset.faults import Fault, Faults
from depthba.dataset.header import read_header
from depthba.dataset.listing import Entry, join, pose_file, read_entries, read_poses
from depthba.dataset.sensor import Sensor


def verify(path: str | Path) -> list[Fault]:
    """Read all of a dataset, images too, and return every fault; empty where it is sound.

    Never raises for a bad dataset. What `Dataset.open` only warns of, such as a truncated last
    line, is no fault.
    """
    root = Path(path)
    faults = Faults(root, strict=False)
    header = read_header(root, faults)
    if any(not fault.file for fault in faults.found):  # no folder or no dataset in it
        return faults.found
    sensor = header.sensor if header is not None else None
    entries, _ = read_entries(root, sensor.kind if sensor else None, faults)
    names = ["measured"] + (["true"] if (root / pose_file("true")).exists() else [])
    for name in names:
        trajectory = read_poses(root, name, faults)
        if trajectory is not None:
            join(entries, trajectory, name, faults)
    for entry in entries:
        _check_files(root, entry, sensor, faults)
    read_markers(root, {entry.id for entry in entries}, faults)
    read_calibration(root, faults)
    return faults.found


def _check_files(root: Path, entry: Entry, sensor: Sensor | None, faults: Faults) -> None:
    for kind, stored in entry.files.items():
        with faults.within(stored.path, entry.id):
            path = root / stored.path
            if sensor is None:
                loading.load_bytes(path, stored.sha256)
            elif kind == "depth":
                loading.load_depth(path, stored.sha256, sensor)
            elif kind == "rgb":
                loading.load_rgb(path, stored.sha256, sensor)
            else:
                loading.load_cloud(path, stored.sha256, sensor)
