"""Whether errors are as large as the stated covariance says, over seeds and scenes.

The joint normalised error squared per degree of freedom is 1 on average for an honest covariance.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

import depthba
from eval.metrics import consistency, pose_metrics
from tests.benchmarks import sets

SCENES = ("lab-1", "lab-2", "lab-3", "industrial-4", "industrial-5", "industrial-6")


def judged(sample: sets.Sample, name: str) -> dict[str, Any]:
    """Register a dataset; its errors against its covariance."""
    T_true = sample.dataset.T_world_camera_true
    assert T_true is not None
    result = depthba.register(sample.dataset)
    found = consistency(result.T_world_camera, T_true, result.covariance)
    error = {m.name: m.value for m in pose_metrics(result.T_world_camera, T_true)}
    before = {m.name: m.value for m in pose_metrics(result.T_world_camera_start, T_true)}
    row = {
        "set": name,
        "seed": sample.seed,
        "status": result.status,
        "nees": found.nees_per_dof,
        "dof": found.dof,
        "inflation": result.inflation,
        "weak": len(result.weak),
        "translation": error["translation_mae"],
        "rotation": error["rotation_mae"],
        "start_translation": before["translation_mae"],
        "start_rotation": before["rotation_mae"],
    }
    print(
        f"  {name} {sample.seed}: NEES {found.nees_per_dof:.2f} over {found.dof}, "
        f"inflation {result.inflation:.1f}, {len(result.weak)} weak directions, {result.status}, "
        f"{1e3 * before['translation_mae']:.3f} / {1e3 * before['rotation_mae']:.3f} -> "
        f"{1e3 * error['translation_mae']:.3f} mm / {1e3 * error['rotation_mae']:.3f} mrad"
    )
    return row


@pytest.mark.parametrize("millimetres", [1, 3])
def test_white_noise_on_smooth_surfaces(
    millimetres: int, benchmark: BenchmarkFixture, tmp_path: Path
) -> None:
    name = f"smooth-{millimetres}mm"
    print()

    def measure() -> list[dict[str, Any]]:
        return [
            judged(sets.smooth(millimetres, seed, sets.folder(tmp_path)), name)
            for seed in sets.seeds(5, 20)
        ]

    rows = benchmark.pedantic(measure, rounds=1)
    sets.keep(f"consistency-{name}", rows)
    pooled = sum(r["nees"] * r["dof"] for r in rows) / sum(r["dof"] for r in rows)
    print(f"{name}: {pooled:.2f} over {len(rows)} seeds, {spread(rows)}")
    assert 0.7 <= pooled <= 1.5


def test_all_noise_on_all_scenes(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    print()

    def scenes() -> Iterator[tuple[str, sets.Sample]]:
        for seed in sets.seeds(1, 5):
            for name in SCENES:
                yield name, sets.real_noise(name, seed, sets.folder(tmp_path))

    rows = benchmark.pedantic(lambda: [judged(s, name) for name, s in scenes()], rounds=1)
    sets.keep("consistency-all-noise", rows)
    typical = float(np.median([r["nees"] for r in rows]))
    print(f"all noise: median {typical:.2f} over {len(rows)} sets, {spread(rows)}")
    assert 0.5 <= typical <= 2.0


def spread(rows: list[dict[str, Any]]) -> str:
    """Return the range that holds the middle 80 %."""
    low, high = np.quantile([r["nees"] for r in rows], [0.1, 0.9])
    return f"middle 80 %: {low:.2f} to {high:.2f}"
