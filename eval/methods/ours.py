"""depthba itself, as one method among the others."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

import depthba
from depthba.result import Iteration
from depthba.trajectory import write_tum
from eval.methods.method import Estimate, Task

ELSEWHERE = ("read", "total")
"""Of the stages of a registration those that no method is charged with."""


@dataclass(frozen=True)
class Depthba:
    """All poses and the map together."""

    preset: Literal["default", "paper"] = "default"
    resolution: float | None = None
    """Finest map spacing, m. None: the preset's own."""
    priors: bool = False
    """Whether the measured poses count as measurements, too, which no other method is given."""

    def run(self, task: Task) -> Estimate:
        """Register the frames from the start poses."""

        def told(iteration: Iteration) -> None:
            task.say(f"level {iteration.level + 1}/{iteration.levels}, step {iteration.index + 1}")

        with tempfile.TemporaryDirectory(prefix="depthba-") as folder:
            start = Path(folder) / "start.txt"
            stamps = np.array([frame.stamp for frame in task.dataset])
            write_tum(start, stamps, task.T_world_camera, "start")
            options = depthba.Options(
                preset=self.preset,
                resolution=self.resolution,
                init=str(start),
                priors=self.priors,
                threads=task.threads,
            )
            result = depthba.register(task.dataset, options, callback=told)
        return Estimate(
            T_world_camera=result.T_world_camera,
            seconds={k: v for k, v in result.seconds.items() if k not in ELSEWHERE},
            notes=() if result.trusted else (f"{result.status}: {result.reason}",),
            iterations=len(result.history),
            depth_map=result.depth_map,
            covariance=result.covariance,
        )


@dataclass(frozen=True)
class DepthbaPaper(Depthba):
    """The formulation of the paper to the letter."""

    preset: Literal["default", "paper"] = "paper"
