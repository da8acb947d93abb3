"""The datasets that accuracy and certainty are measured on, and how many of them a run takes.

A few by default, so that `make bench` stays a matter of minutes:

- ``BENCH_FULL=1`` takes all sets and seeds;
- ``BENCH_SEEDS=N`` takes N seeds, ``BENCH_SETS=a,b`` the named sets;
- ``BENCH_DATA=FOLDER`` keeps what is generated there for the next run.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import sim
from depthba.dataset import Dataset
from tests.benchmarks.relief import Relief

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared"
FULL = os.environ.get("BENCH_FULL") == "1"


@dataclass(frozen=True)
class Sample:
    """A dataset, and the relief it shows where it is one."""

    seed: int
    dataset: Dataset
    relief: Relief | None = None

    @property
    def clean(self) -> list[NDArray[np.float64]] | None:
        """The frames without noise, m, where the bound cannot know by itself."""
        return None if self.relief is None else self.relief.depths()


def seeds(usual: int, full: int) -> range:
    """Return the seeds to take."""
    return range(int(os.environ.get("BENCH_SEEDS", full if FULL else usual)))


def chosen(name: str, usual: Sequence[str]) -> None:
    """Skip the test unless its set is asked for."""
    asked = os.environ.get("BENCH_SETS")
    if asked is not None:
        usual = asked.split(",")
    elif FULL:
        return
    if name not in usual:
        pytest.skip(f"{name}: only with BENCH_FULL=1 or BENCH_SETS={name}")


def folder(fallback: Path) -> Path:
    """Return where generated sets go."""
    return Path(os.environ.get("BENCH_DATA", fallback))


def industrial(name: str, seed: int, where: Path) -> Sample:
    """White range noise and starts 30 mm, 20 mrad off."""
    options = sim.GenerateOptions(
        seed=seed, frames=21, size=(320, 240), white=True, start_error=(0.03, 0.02), rgb=False
    )
    path = sim.generate(name, where / f"{name}-white-{seed}", options)
    return Sample(seed, Dataset.open(path))


def smooth(millimetres: int, seed: int, where: Path) -> Sample:
    """A relief of waves with so much range noise; starts 10 mm, 20 mrad off."""
    relief = Relief(seed=seed, noise=millimetres / 1000)
    return Sample(seed, relief.write(where / f"smooth-{millimetres}mm-{seed}"), relief)


def real_noise(name: str, seed: int, where: Path) -> Sample:
    """A scene as its rig and sensor capture it, all stages of the noise, a quarter as wide."""
    size = (320, 240) if name.startswith("industrial") else (320, 180)
    options = sim.GenerateOptions(seed=seed, size=size, rgb=False)
    return Sample(seed, Dataset.open(sim.generate(name, where / f"{name}-all-{seed}", options)))


def beside(name: str) -> Sample:
    """One of the sets that lie beside the checkout."""
    if not (SHARED / "data" / name).is_dir():
        pytest.skip(f"{SHARED.name}/data/{name} is not beside this checkout")
    return Sample(0, Dataset.open(SHARED / "data" / name))


def keep(name: str, rows: Sequence[dict[str, Any]]) -> None:
    """Write what was measured to logs/bench/NAME.json."""
    path = ROOT / "logs" / "bench" / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(list(rows), indent=1) + "\n", encoding="utf-8")
