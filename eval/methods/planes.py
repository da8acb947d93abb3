"""Bundle adjustment on planes, BALM2: as published, and as well as it goes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from depthba.errors import OptionError
from eval.methods.balm2.attempts import register_best
from eval.methods.balm2.schedule import Registered, Schedule, register
from eval.methods.balm2.solver import SolverOptions
from eval.methods.features import near_clouds
from eval.methods.method import Estimate, MethodError, Stopwatch, Task

FIXED = 0.18
"""Voxels of one size have this part of a frame's extent as their edge: 0.1 m, the paper's default,
where a frame sees 0.65 m by 0.49 m."""
COARSEST = 0.29
"""Of a frame's extent. At 0.5 frames that stand a centimetre off fall onto each other."""
FINEST = 8.0
"""In point spacings. Of a plane's 15 points a smallest voxel, a quarter as long, must get some from
each frame."""
SMALLER = (1 / 2, 3 / 8, 3 / 4)
"""Of the coarsest voxels, those that further schedules begin with."""
LOOSE = 15.0
"""In point spacings: voxels above this may look for bent planes; in smaller ones that costs
accuracy."""
ENOUGH = 0.8
"""Share of points on planes that only frames that fit were seen to reach: on relief 0.85 to 0.95,
where frames were lost 0.2 to 0.5."""


@dataclass(frozen=True)
class Balm2:
    """As published: planes found once, in voxels of one size, at the start poses."""

    voxel: float | None = None
    """Edge of the root voxels, m; None: 0.18 of a frame's extent, the root of the area it sees."""
    thinned: float | None = None
    """Edge of the cubes that frames are thinned by, m; None: 1.5 point spacings."""

    def run(self, task: Task) -> Estimate:
        """Register the frames from the start poses."""
        task = replace(task, clouds=near_clouds(task))
        voxel = FIXED * frame_extent(task) if self.voxel is None else self.voxel
        schedule = Schedule((voxel,), _thinned(task, self.thinned, 1.5))
        watch = Stopwatch()
        found = register(task.clouds, task.T_world_camera, schedule, watch, task.say)
        return _estimate(task, found, watch)


@dataclass(frozen=True)
class Balm2CoarseToFine:
    """As well as it goes: voxels halve, and in each size planes are found until the poses settle.

    Beyond the paper, too, a solution may not lead points away from where their planes were found,
    by more than a quarter of a voxel, nor those of one size together by a whole one. A size at
    which most planes are lost, because it shows noise, is left out.

    Up to four schedules are tried: from voxels that take in bad starts, with flat planes only; then
    with bent ones from smaller voxels, where relief is strong. The one that leaves the most points
    on planes counts.
    """

    coarsest: float | None = None
    """Edge of the first root voxels, m; None: 0.29 of a frame's extent."""
    finest: float | None = None
    """No voxel is smaller, m; None: 8 point spacings."""
    thinned: float | None = None
    """Edge of the cubes that frames are thinned by, m, or more, a fortieth of the voxels; None: the
    point spacing."""
    rounds: int = 15
    """How often planes are found in one size, at most."""
    attempts: int = 4
    """How many schedules are tried, at most."""

    def run(self, task: Task) -> Estimate:
        """Register the frames from the start poses."""
        task = replace(task, clouds=near_clouds(task))
        coarsest = COARSEST * frame_extent(task) if self.coarsest is None else self.coarsest
        finest = FINEST * task.spacing if self.finest is None else self.finest
        flat = Schedule(
            voxels=halvings(coarsest, finest),
            thinned=_thinned(task, self.thinned, 1.0),
            points_across=40.0,
            rounds=self.rounds,
            least_share=0.25,
            reach=0.25,
            farthest=1.0,
            solver=SolverOptions(iterations=20, downhill=True),
        )
        bent = replace(flat, loose_above=LOOSE * task.spacing)
        schedules = [flat]
        schedules += [replace(bent, voxels=halvings(k * coarsest, finest)) for k in SMALLER]
        watch = Stopwatch()
        found = register_best(
            task.clouds,
            task.T_world_camera,
            schedules[: self.attempts],
            max(coarsest / 2.0, finest),
            ENOUGH,
            watch,
            task.say,
        )
        return _estimate(task, found, watch)


def halvings(coarsest: float, finest: float) -> tuple[float, ...]:
    """Return sizes that halve, m: from the coarsest one to the last that is not below the finest.

    The coarsest one is there in any case.
    """
    if not (0 < coarsest < np.inf and finest > 0):
        raise OptionError(f"voxels from {coarsest} to {finest} m: must be above 0 and finite")
    count = max(int(np.floor(np.log2(coarsest / finest) + 1e-9)), 0) + 1
    return tuple(coarsest / 2.0**k for k in range(count))


def frame_extent(task: Task) -> float:
    """Return the root of the area that a frame sees, m: as many squares of the spacing as points.

    Raises:
        MethodError: there are no points.

    """
    counts = [len(points) for points in task.clouds if len(points)]
    if not counts or not np.isfinite(task.spacing):
        raise MethodError("no frame has points")
    return float(task.spacing * np.sqrt(np.median(counts)))


def _thinned(task: Task, cell: float | None, spacings: float) -> float:
    return spacings * task.spacing if cell is None else cell


def _estimate(task: Task, found: Registered, watch: Stopwatch) -> Estimate:
    notes = []
    if held := found.stages[-1].held:
        frames = ", ".join(str(task.dataset[k].id) for k in held)
        notes.append(f"frames that see too few planes to move: {frames}")
    last = found.stages[-1]
    return Estimate(found.T_world_camera, watch.seconds, tuple(notes), last.iterations)
