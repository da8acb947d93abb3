"""From coarse voxels to fine ones: planes are found and frames moved, again and again.

The paper finds planes once, in voxels of one size. That holds only where the start is good and the
scene is flat over a voxel. Large voxels take frames in from afar and are wrong on curved surfaces;
small ones are right and want frames that nearly fit. So a size is used until the poses settle, then
its half.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.clouds import thin
from eval.methods.balm2.clusters import Floats
from eval.methods.balm2.solver import SolverOptions, displacement, solve
from eval.methods.balm2.voxels import Planes, VoxelOptions, find_planes
from eval.methods.method import MethodError, Stopwatch

Cloud = NDArray[np.float32]


@dataclass(frozen=True)
class Schedule:
    """Which voxels, how often, and when it is enough."""

    voxels: tuple[float, ...]
    """Edges of the root voxels, m, in the order of their use."""
    thinned: float
    """Edge of the cubes of which one mean point is kept, m."""
    points_across: float = float("inf")
    """A voxel need not hold more points along an edge than this: coarse ones are thinned more."""
    rounds: int = 1
    """How often planes are found anew in voxels of one size, at most."""
    settled: float = 0.01
    """The next size follows once no frame's points move by more than this, in voxels."""
    least_share: float = 0.0
    """A size leaves at least this part of the share of points on planes that the one before had:
    smaller voxels see noise, not surface. Otherwise the result is that of the size before."""
    farthest: float = float("inf")
    """A size that takes a frame's points farther than that from where it found them, root mean
    square, in voxels, is passed over: planes were not there to lead so far. (Voxels of half a
    frame's extent let frames fall onto each other.)"""
    least_planes: int = 6
    """A frame that sees fewer planes stays where it is."""
    search: VoxelOptions = field(default_factory=VoxelOptions)
    """But for the size."""
    loose: tuple[float, ...] = (1 / 4, 1 / 4, 1 / 4)
    """Flatness by layer in large voxels, whose pieces of surface are curved."""
    loose_above: float = float("inf")
    """Which voxels are large, m."""
    solver: SolverOptions = field(default_factory=SolverOptions)
    """But for the reach."""
    reach: float = float("inf")
    """Of the solver, in voxels."""


@dataclass(frozen=True)
class Stage:
    """What came of one size."""

    voxel: float
    """m."""
    rounds: int
    """Times that planes were found and frames moved."""
    iterations: int
    """Of the solver, over all rounds."""
    planes: int
    share: float
    """Of all points, those on planes."""
    cost: float
    """At the end, m²."""
    held: tuple[int, ...]
    """Frames that saw too few planes to move."""


@dataclass(frozen=True, eq=False)
class Registered:
    """What came of all sizes."""

    T_world_camera: Floats
    """(N, 4, 4), the first frame's as it was."""
    stages: tuple[Stage, ...]
    """Whose result that is, in order."""
    refused: tuple[str, ...] = ()
    """Why voxels that were asked for are not among them, one line each."""


def register(
    clouds: Sequence[NDArray[np.floating]],
    T_world_camera: Floats,
    schedule: Schedule,
    watch: Stopwatch,
    say: Callable[[str], None] = lambda _: None,
) -> Registered:
    """Register frames by their planes.

    Args:
        clouds: per frame (n, 3), sensor frame, m.
        T_world_camera: (N, 4, 4), the start.
        schedule: the sizes.
        watch: is charged with the stages "thin", "planes" and "solve".
        say: told where it is.

    Raises:
        MethodError: no frame sees planes enough.

    """
    # voxels lie along the first frame's axes, and steps turn about it, wherever the world is
    T_world_first = T_world_camera[0]
    T = np.asarray(se3.inverse(T_world_first) @ T_world_camera)
    stages: list[Stage] = []
    thinned, cell = [np.zeros((0, 3), np.float32)] * len(clouds), 0.0
    refused: list[str] = []
    for voxel in schedule.voxels:
        name = _name(voxel)
        wanted = max(schedule.thinned, voxel / schedule.points_across)
        if wanted != cell:
            with watch("thin"):
                thinned, cell = thinned_clouds(clouds, wanted), wanted
        with watch("planes"):
            planes = find_planes(thinned, T, _search(schedule, voxel))
        if not _movable(planes, schedule.least_planes).any():
            refused.append(f"{name}: no frame sees {schedule.least_planes} planes")
            continue
        share, before = _share(planes, thinned), stages[-1].share if stages else 0.0
        if share < schedule.least_share * before:
            refused.append(f"{name}: {share:.1%} of the points on planes, {before:.1%} before")
            break
        moved, stage = _settle(thinned, T, planes, voxel, schedule, watch, say)
        far = displacement(planes, T, moved)
        if far.max() > schedule.farthest * voxel:
            refused.append(f"{name}: lead frame {far.argmax()} away, by {far.max():.3g} m")
            continue
        stages.append(stage)
        T = moved
    if not stages:
        raise MethodError("; ".join(refused) or "no voxels were asked for")
    return Registered(T_world_first @ T, tuple(stages), tuple(refused))


def _settle(
    clouds: Sequence[Cloud],
    T: Floats,
    planes: Planes,
    voxel: float,
    schedule: Schedule,
    watch: Stopwatch,
    say: Callable[[str], None],
) -> tuple[Floats, Stage]:
    """Move the frames, and find planes anew, until poses settle."""
    search = _search(schedule, voxel)
    solver = replace(schedule.solver, reach=schedule.reach * voxel)
    iterations, rounds = 0, 0
    while True:
        say(f"{_name(voxel)}, round {rounds + 1}, {len(planes)} planes")
        moves = _movable(planes, schedule.least_planes)
        with watch("solve"):
            solution = solve(planes, T, solver, moves)
        iterations += len(solution.trials)
        rounds += 1
        moved = displacement(planes, T, solution.T_world_camera).max()
        T = solution.T_world_camera
        if rounds >= schedule.rounds or moved < schedule.settled * voxel:
            break
        with watch("planes"):
            again = find_planes(clouds, T, search)
        if not _movable(again, schedule.least_planes).any():
            break
        planes = again
    held = tuple(int(k) for k in np.flatnonzero(~_movable(planes, schedule.least_planes)))
    share = _share(planes, clouds)
    return T, Stage(voxel, rounds, iterations, len(planes), share, solution.cost, held)


def _movable(planes: Planes, least: int) -> NDArray[np.bool_]:
    """Return (N,), the frames that see ``least`` planes together with others that move."""
    moves = planes.per_frame >= least
    while not np.array_equal(moves, still := moves & (planes.only(moves).per_frame >= least)):
        moves = still
    return moves


def plane_share(clouds: Sequence[Cloud], T_world_camera: Floats, search: VoxelOptions) -> float:
    """Return the part of all points that lie on planes, the frames (N, 4, 4) being there."""
    return _share(find_planes(clouds, T_world_camera, search), clouds)


def thinned_clouds(clouds: Sequence[NDArray[np.floating]], cell: float) -> list[Cloud]:
    """Return the mean point per cube of an edge of ``cell``, m, frame by frame."""
    return [thin(np.asarray(c, dtype=np.float64), cell).astype(np.float32) for c in clouds]


def _search(schedule: Schedule, voxel: float) -> VoxelOptions:
    if voxel > schedule.loose_above:
        return replace(schedule.search, size=voxel, flatness=schedule.loose)
    return replace(schedule.search, size=voxel)


def _share(planes: Planes, clouds: Sequence[Cloud]) -> float:
    """Return the part of all points that lie on planes."""
    return planes.points / max(sum(len(c) for c in clouds), 1)


def _name(voxel: float) -> str:
    return f"voxels of {1e3 * voxel:.3g} mm"
