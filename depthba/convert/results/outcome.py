"""What there is to write: the poses, map and cloud of a run, or the poses of a dataset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba.dataset import Dataset
from depthba.depth_map import DepthMap
from depthba.errors import RunError
from depthba.stored_run import Run

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What there is to write."""

    path: Path
    """Of the run or the dataset."""
    stamps: Array
    """(N,), s."""
    T_world_camera: Array
    """(N, 4, 4), m."""
    covariance: Array | None = None
    """(6N, 6N), see `depthba.result.Result`."""
    depth_map: DepthMap | None = None
    cloud: Path | None = None
    """A PLY file, in world coordinates."""
    dataset: Callable[[], Dataset] | None = None
    """Opens the frames."""

    @classmethod
    def of_run(cls, path: Path) -> Outcome:
        """Open a run folder. `RunError`: it is not whole."""
        run = Run.open(path)
        return cls(
            path=path,
            stamps=run.stamps,
            T_world_camera=run.T_world_camera,
            covariance=run.covariance,
            depth_map=run.depth_map,
            cloud=path / "cloud.ply",
            dataset=lambda: _frames(run),
        )

    @classmethod
    def of_dataset(cls, dataset: Dataset, T_world_camera: Array) -> Outcome:
        """Take poses (N, 4, 4) of a dataset's frames."""
        return cls(dataset.path, dataset.stamps, T_world_camera, dataset=lambda: dataset)

    def map(self) -> DepthMap:
        """Return the depth map. `RunError`: there is none."""
        if self.depth_map is None:
            raise RunError(f"{self.path}: has no depth map, expected a run folder")
        return self.depth_map


@dataclass(frozen=True)
class ResultFormat:
    """A kind of file that results are written to."""

    name: str
    title: str
    suffixes: tuple[str, ...]
    """The first is the usual one. Names of other formats may end alike."""
    write: Callable[[Outcome, Path], None]


def _frames(run: Run) -> Dataset:
    """Open the frames of a run, and those alone that were registered."""
    dataset = Dataset.open(run.dataset_path)
    known = {round(float(stamp), 6): row for row, stamp in enumerate(dataset.stamps)}
    try:
        rows = [known[round(float(stamp), 6)] for stamp in run.stamps]
    except KeyError as error:
        raise RunError(
            f"{run.path}: stamp {error} s is of no frame in {dataset.path}: did it change?"
        ) from error
    return dataset.subset(rows)
