"""Methods that end in every way that there is."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.methods import Estimate, MethodError, Task


@dataclass(frozen=True)
class Knows:
    """Returns the truth, 1 mm along x off, in any world frame."""

    def run(self, task: Task) -> Estimate:
        T = task.dataset.T_world_camera_true.copy()
        T[1:, 0, 3] += 0.001
        elsewhere = np.eye(4)
        elsewhere[:3, 3] = 5.0, 6.0, 7.0
        return Estimate(elsewhere @ T, {"look": 1.0, "copy": 0.5}, iterations=3)


@dataclass(frozen=True)
class Refuses:
    def run(self, task: Task) -> Estimate:
        raise MethodError("frames 1 and 2 share nothing")


@dataclass(frozen=True)
class Raises:
    def run(self, task: Task) -> Estimate:
        return {}["nothing"]


@dataclass(frozen=True)
class Dies:
    def run(self, task: Task) -> Estimate:
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError


@dataclass(frozen=True)
class Fills:
    """Writes more than its disk takes, once: the second time there is room."""

    def run(self, task: Task) -> Estimate:
        if not task.dataset.path.name.startswith("waves"):  # what is run before, untimed
            return Estimate(task.T_world_camera, {})
        tried = task.dataset.path.with_suffix(".tried")
        if tried.exists():
            return Estimate(task.T_world_camera, {})
        tried.touch()
        try:
            with open("/dev/full", "wb", 0) as file:
                file.write(bytes(9))
        except OSError as error:
            raise MethodError("its work could not be put down") from error
        raise AssertionError


@dataclass(frozen=True)
class FullForGood:
    def run(self, task: Task) -> Estimate:
        with open("/dev/full", "wb", 0) as file:
            file.write(bytes(9))
        raise AssertionError


@dataclass(frozen=True)
class Diverges:
    def run(self, task: Task) -> Estimate:
        return Estimate(np.full((len(task), 4, 4), np.nan), {})


@dataclass(frozen=True)
class Sleeps:
    def run(self, task: Task) -> Estimate:
        time.sleep(600)
        raise AssertionError


@dataclass(frozen=True)
class Hoards:
    def run(self, task: Task) -> Estimate:
        kept = []
        while True:
            kept.append(np.ones(5_000_000))
            time.sleep(0.02)


@dataclass(frozen=True)
class Counts:
    """Returns what it was given, after a while, and notes down when it began and when it ended.

    A line each in runs.txt beside the dataset's folder: dataset, process that asked for it, which.
    """

    def run(self, task: Task) -> Estimate:
        path = task.dataset.path
        if not path.name.startswith("waves-"):  # a small scene before the one that is timed
            return Estimate(task.T_world_camera, {"wait": 0.0})
        _note(path.parent, f"{path.name} {os.getppid()} began")
        time.sleep(1.0)
        _note(path.parent, f"{path.name} {os.getppid()} ended")
        return Estimate(task.T_world_camera, {"wait": 1.0})


def _note(folder: Path, line: str) -> None:
    with (folder / "runs.txt").open("a", encoding="utf-8") as file:
        file.write(line + "\n")  # one write of few bytes at the end of a file is whole
