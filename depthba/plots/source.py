"""A finished run with its frames, as the plots take it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba.clouds import FrameCloud, inside, load_clouds, transform
from depthba.dataset import Dataset
from depthba.depth_map import DepthMap
from depthba.errors import RunError
from depthba.options import Options, options_of
from depthba.selecting import selected
from depthba.stored_run import Run

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Source:
    """A run, and the dataset that it is of. Files are read when they are asked for."""

    run: Run
    dataset_path: Path

    @classmethod
    def open(cls, path: str | os.PathLike[str], dataset: Path | None = None) -> Source:
        """Open a run folder.

        Args:
            path: of the run.
            dataset: folder of its dataset; None: the one that the run remembers.

        Raises:
            RunError: the run is not whole.

        """
        run = Run.open(path)
        return cls(run, run.dataset_path if dataset is None else dataset)

    @property
    def name(self) -> str:
        """What the run is called."""
        return self.run.name

    @property
    def frame_ids(self) -> list[int]:
        """Ids of the frames, in the order of the poses."""
        return [int(frame["frame"]) for frame in self.run.result["frames"]]

    @property
    def status(self) -> str:
        """How the registration ended."""
        return str(self.run.result["status"])

    @property
    def depth_map(self) -> DepthMap:
        """The map after."""
        return self.run.depth_map

    @property
    def depth_map_start(self) -> DepthMap:
        """The map that the start poses give. RunError where the run does not hold it."""
        if self.run.depth_map_start is None:
            raise RunError(f"{self.run.path}: has no map_start.npz: register it anew for this plot")
        return self.run.depth_map_start

    @property
    def T_world_camera(self) -> Floats:
        """(N, 4, 4), estimated."""
        return self.run.T_world_camera

    @property
    def T_world_camera_start(self) -> Floats:
        """(N, 4, 4), where it began. RunError where the run does not hold it."""
        if self.run.T_world_camera_start is None:
            raise RunError(
                f"{self.run.path}: has no poses_start.txt: register it anew for this plot"
            )
        return self.run.T_world_camera_start

    @cached_property
    def options(self) -> Options:
        """The options in force."""
        return options_of(self.run.config)

    @cached_property
    def dataset(self) -> Dataset:
        """The frames that took part. RunError where the dataset is not there."""
        if not self.dataset_path.is_dir():
            raise RunError(
                f"{self.run.path}: its dataset {self.dataset_path} is not there; say where with "
                "--dataset"
            )
        return selected(Dataset.open(self.dataset_path), self.options)

    @cached_property
    def clouds(self) -> tuple[FrameCloud, ...]:
        """The points of all frames, sensor frame, without colours."""
        clouds = load_clouds(self.dataset, colours=False)
        if len(clouds) != len(self.T_world_camera):
            raise RunError(
                f"{self.run.path}: {len(self.T_world_camera)} poses for {len(clouds)} frames in "
                f"{self.dataset_path}: did it change?"
            )
        return clouds

    def points_map(self) -> list[Floats]:
        """Return per frame (n, 3) points in the map frame at the estimate, region kept alone."""
        T_map_world = self.depth_map.T_map_world
        found = []
        for cloud, T in zip(self.clouds, self.T_world_camera, strict=True):
            p = transform(T_map_world @ T, cloud.points)
            found.append(p[inside(p, self.options.roi)])
        return found
