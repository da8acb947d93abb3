"""What every method of the benchmark gets and gives, so that all are timed and judged alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.clouds import load_clouds, point_spacing
from depthba.dataset import Dataset
from depthba.depth_map import DepthMap

Floats = NDArray[np.float64]
Say = Callable[[str], None]
"""Told, in a few words, what a method does now."""


class MethodError(Exception):
    """A method found no answer; the text says why, in one line. A row of the report, no crash."""


@dataclass(frozen=True, eq=False)
class Task:
    """Frames to register, and where they stand roughly."""

    dataset: Dataset
    T_world_camera: Floats
    """(N, 4, 4), the start; frame 0's is kept as it is."""
    clouds: tuple[Floats, ...]
    """Per frame (n, 3), sensor frame, m."""
    spacing: float
    """Typical distance of neighbouring points, m."""
    threads: int = 1
    cache: Path | None = None
    """Folder for what several methods share on this dataset and start, such as feature pairs; what
    is taken from there is charged with the seconds that it took to make. None: nothing is kept."""
    say: Say = field(default=lambda _: None)

    @classmethod
    def of(
        cls,
        dataset: Dataset,
        T_world_camera: Floats | None = None,
        threads: int = 1,
        cache: Path | None = None,
        say: Say = lambda _: None,
    ) -> Task:
        """Read a dataset; the start is its measured poses where none is given."""
        clouds = tuple(c.points for c in load_clouds(dataset, colours=False))
        start = dataset.T_world_camera_measured if T_world_camera is None else T_world_camera
        return cls(
            dataset, start, clouds, point_spacing(dataset, clouds), threads, cache, say
        )  # fmt: skip

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.clouds)


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a method found."""

    T_world_camera: Floats
    """(N, 4, 4)."""
    seconds: Mapping[str, float]
    """By stage, in the order in which they ran; reading the dataset is not among them."""
    notes: tuple[str, ...] = ()
    """One line each: what a reader of the report must know, such as pairs that failed."""
    iterations: int | None = None
    """Of the last optimisation, where there is one."""
    depth_map: DepthMap | None = None
    covariance: Floats | None = None
    """(6N, 6N), see `depthba.result.Result`; None where the method does not tell."""


class Method(Protocol):
    """A way to register frames: a frozen dataclass whose fields are its options."""

    def run(self, task: Task) -> Estimate:
        """Register the frames.

        Raises:
            MethodError: no answer.

        """
        ...


class Stopwatch:
    """Seconds by stage."""

    def __init__(self) -> None:
        """Begin with no stage."""
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time what runs inside."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.charge(stage, time.perf_counter() - began)

    def charge(self, stage: str, seconds: float) -> None:
        """Add seconds to a stage: of work that was done before, and is used again."""
        self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds


def chained(first: Floats, steps: list[Floats]) -> Floats:
    """Return poses (N, 4, 4) from the first (4, 4) and T_k_k+1 (4, 4) between neighbours."""
    poses = [first]
    for T in steps:
        poses.append(poses[-1] @ T)
    return np.stack(poses)


def relative(T_world_camera: Floats, i: int, j: int) -> Floats:
    """Return T_i_j (4, 4) of two frames."""
    return se3.inverse(T_world_camera[i]) @ T_world_camera[j]
