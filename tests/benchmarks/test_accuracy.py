"""Errors of the default preset over the Cramér-Rao bound, and beside GICP pairs tuned on the truth.

The resolution is the one that it chooses by itself; errors are mean absolute per axis. The peer is
the GICP pose graph beside the checkout, at the voxel and the first correspondence distance of a
sweep that are best on that dataset: a choice that only truth can make. `tests/benchmarks/sets.py`
says how many sets and seeds are taken.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

import depthba
from depthba.dataset import Dataset
from depthba.trajectory import read_tum
from eval.bound import bound
from eval.metrics import consistency, pose_metrics
from tests.benchmarks import sets
from tests.benchmarks.relief import Relief

PEER = sets.SHARED / "tools" / "peer_gicp.py"
VOXELS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0) if sets.FULL else (0.7, 1.0, 2.0)
REACHES = (25.0, 10.0, 5.0) if sets.FULL else (25.0, 5.0)
"""First correspondence distance, point spacings; it matters as much as the voxel."""


@dataclass(frozen=True)
class Aim:
    """What the medians over the seeds must not exceed."""

    bounds: float | None = None
    """Error over the bound, translation and rotation."""
    peer: float | None = None
    """Error over the peer's."""
    errors: tuple[float, float] | None = None
    """Translation, m, and rotation, rad."""


AIMS = {
    "industrial-4": Aim(bounds=2.5, peer=0.5),
    "industrial-5": Aim(bounds=2.5, peer=0.5),
    "industrial-6": Aim(bounds=2.5, peer=0.5),
    "smooth-1mm": Aim(bounds=1.5),
    "smooth-3mm": Aim(bounds=1.5),
    "rock-field": Aim(errors=(2.0e-5, 8.0e-6)),
    "bumpy-a": Aim(errors=(5.0e-5, 9.5e-5)),
    "bumpy-b": Aim(errors=(1.7e-4, 3.0e-4)),
}
USUAL = ("industrial-5", "smooth-1mm", "smooth-3mm", "rock-field", "bumpy-a", "bumpy-b")


@pytest.fixture(scope="module", autouse=True)
def compiled(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Compile the kernels, so that no seconds below hold that."""
    small = Relief(columns=2, rows=1, size=(64, 48))
    depthba.register(small.write(tmp_path_factory.mktemp("warm") / "relief"))


def samples(name: str, where: Path) -> Iterator[sets.Sample]:
    """Yield the set's datasets."""
    if name.startswith("industrial"):
        yield from (sets.industrial(name, seed, where) for seed in sets.seeds(2, 5))
    elif name.startswith("smooth"):
        yield from (sets.smooth(int(name[7]), seed, where) for seed in sets.seeds(3, 5))
    else:
        yield sets.beside(name)


def measured(sample: sets.Sample) -> dict[str, Any]:
    """Register a dataset and judge the result."""
    dataset = sample.dataset
    T_true = dataset.T_world_camera_true
    assert T_true is not None
    result = depthba.register(dataset)
    error = {m.name: m.value for m in pose_metrics(result.T_world_camera, T_true)}
    least = bound(dataset, result.depth_map.spacing, sample.clean)
    return {
        "seed": sample.seed,
        "status": result.status,
        "spacing": result.depth_map.spacing,
        "translation": error["translation_mae"],
        "rotation": error["rotation_mae"],
        "translation_bound": least.translation,
        "rotation_bound": least.rotation,
        "translation_over_bound": error["translation_mae"] / least.translation,
        "rotation_over_bound": error["rotation_mae"] / least.rotation,
        "nees": consistency(result.T_world_camera, T_true, result.covariance).nees_per_dof,
        "seconds": result.seconds["total"] - result.seconds["read"],
    }


def peer(dataset: Dataset, folder: Path) -> dict[str, Any]:
    """Return the peer's best of the sweep; its seconds are without reading."""
    T_true = dataset.T_world_camera_true
    assert T_true is not None
    camera = dataset.sensor.camera
    assert camera is not None
    spacing = float(np.median(dataset.frames[0].points()[:, 2])) / camera.fx
    runs = []
    for factor, reach in product(VOXELS, REACHES):
        out = folder / f"{dataset.path.name}-{factor}-{reach}.txt"
        command = [
            sys.executable, str(PEER), str(dataset.path), "--ds", f"{factor * spacing:.6f}",
            "--maxcorr", f"{reach * spacing:.6f}", "--out", str(out),
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=PEER.parent)
        wall = re.search(r"wall ([0-9.]+) s", done.stdout)
        if done.returncode or wall is None:
            continue
        error = {m.name: m.value for m in pose_metrics(read_tum(out)[1], T_true)}
        runs.append(
            {
                "peer_voxel": factor * spacing,
                "peer_reach": reach * spacing,
                "peer_translation": error["translation_mae"],
                "peer_rotation": error["rotation_mae"],
                "peer_seconds": float(wall.group(1)),
            }
        )
    return min(runs, key=lambda r: r["peer_translation"], default={})


@pytest.mark.parametrize("name", AIMS)
def test_accuracy(name: str, benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    sets.chosen(name, USUAL)
    aim = AIMS[name]

    def measure() -> list[dict[str, Any]]:
        rows = []
        for sample in samples(name, sets.folder(tmp_path)):
            row = measured(sample)
            if PEER.is_file() and (sets.FULL or sample.seed == 0):
                row |= peer(sample.dataset, tmp_path)
            rows.append(row)
        return rows

    rows = benchmark.pedantic(measure, rounds=1)
    sets.keep(f"accuracy-{name}", rows)
    print(f"\n{name}: mm / mrad; the peer at its best; NEES per degree of freedom")
    print(HEAD)
    for row in rows:
        print(line(row))
    typical = {
        key: float(np.median([row[key] for row in rows if key in row]))
        for key in {k for row in rows for k in row} - {"status", "seed"}
    }
    print(line({**typical, "seed": "median", "status": ""}))
    if aim.bounds is not None:
        assert typical["translation_over_bound"] <= aim.bounds
        assert typical["rotation_over_bound"] <= aim.bounds
    if aim.errors is not None:
        assert typical["translation"] <= aim.errors[0] and typical["rotation"] <= aim.errors[1]
    if aim.peer is not None and "peer_translation" in typical:
        both = [row for row in rows if "peer_translation" in row]
        for part in ("translation", "rotation"):
            share = np.median([row[part] / row[f"peer_{part}"] for row in both])
            assert share <= aim.peer, part


HEAD = (
    "  seed    spacing  error            bound            over bound   NEES  status         "
    "peer's error     at           error, time over peer's"
)


def line(row: dict[str, Any]) -> str:
    """Format a row of the table."""
    text = (
        f"  {row['seed']!s:6} {1e3 * row['spacing']:5.1f} mm"
        f"  {1e3 * row['translation']:.4f} / {1e3 * row['rotation']:.4f}"
        f"  {1e3 * row['translation_bound']:.4f} / {1e3 * row['rotation_bound']:.4f}"
        f"  {row['translation_over_bound']:.2f} / {row['rotation_over_bound']:.2f}"
        f"  {row['nees']:5.2f}  {row['status']:13}"
    )
    if "peer_translation" in row:
        text += (
            f"  {1e3 * row['peer_translation']:.4f} / {1e3 * row['peer_rotation']:.4f}"
            f"  {1e3 * row['peer_voxel']:4.1f}, {1e3 * row['peer_reach']:3.0f} mm"
            f"  {row['translation'] / row['peer_translation']:.2f}"
            f"  {row['seconds'] / row['peer_seconds']:.2f}"
        )
    return text
