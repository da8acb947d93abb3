"""What callers get to see: iterations, maps, frames, and the verdict in words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.depth_map import DepthMap
from depthba.optimiser import certainty
from depthba.optimiser.clock import Clock
from depthba.optimiser.grid import average, near
from depthba.optimiser.level import Level
from depthba.optimiser.linearise import Linearisation, State
from depthba.optimiser.problem import Problem
from depthba.optimiser.solver import Outcome, Progress
from depthba.result import FrameReport, Iteration, Status
from depthba.words import count

# Standard deviations of a measured pose, as they were stated and as they are supposed where nobody
# stated any, beyond which pose and points contradict each other.
FAR, FAR_SUPPOSED = 10.0, 25.0

# A frame fits no more whose points agree with the map by less than this share of the usual, while
# so many times the usual share do not (nowhere below 0.75 and above 3.1 in frames that were right).
FITTING, STRAYS, LEAST_STRAYS = 0.72, 4.0, 0.02


def astray(
    ids: tuple[int, ...], distances: NDArray[np.float64], believed: bool, stated: bool
) -> list[str]:
    """Say which frames ended where their measured poses cannot be meant: one of the two is wrong.

    An image of something else, or upside down, finds a place to fit as a rule, only not its own.

    Args:
        ids: of the frames.
        distances: (N,) from the measured poses, in their deviations.
        believed: whether the measured poses take part.
        stated: whether their deviations were stated.
    """
    far = FAR if stated else FAR_SUPPOSED
    return [
        f"frame {i} lies {d:.0f} {'stated' if stated else 'usual'} deviations from its measured "
        "pose: either its image or its pose is wrong"
        for i, d in zip(ids, distances, strict=True)
        if believed and d > far
    ]


def misfits(frames: tuple[FrameReport, ...]) -> list[str]:
    """Say which frames do not fit the map as the others do.

    That is many times the usual share of points that the robust loss lets go of, and so many that
    fewer of the rest agree than by any occlusion.
    """
    usual = float(np.median([f.inliers for f in frames if f.points]))
    return [
        f"frame {f.frame} does not fit the map: {100 * f.inliers:.0f} % of its points agree with "
        f"it, of a usual frame's {100 * usual:.0f} %"
        for f in frames
        if f.points
        and f.inliers < FITTING * usual
        and 1 - f.inliers > STRAYS * max(1 - usual, LEAST_STRAYS)
    ]


def verdict(
    outcome: Outcome, better: bool, judged: certainty.Certainty, frames: tuple[FrameReport, ...],
    gone: list[str], clock: Clock,
) -> tuple[Status, str]:  # fmt: skip
    """Say how the registration ended, in one word and one sentence."""
    if not better:
        return "no_better", "no poses better than the start were found; the start is returned"
    starved = [f for f in frames[1:] if f.held]
    weak = sorted({w.frame for w in judged.weak})
    if starved or weak or gone:
        parts = [f"frame {f.frame} was held: {f.held}" for f in starved]
        if weak:
            parts.append(
                f"the data leave {count(len(judged.weak), 'direction')} of "
                f"{count(len(weak), 'frame')} to the measured poses"
            )
        return "weak", "; ".join(parts + gone)
    if not outcome.converged and clock.over:
        return "not_converged", f"the time limit of {clock.limit:g} s ended the iterations"
    if not outcome.converged:
        return "not_converged", "the iterations ended before the poses settled"
    return "converged", "the poses settled"


def frame_reports(
    ids: tuple[int, ...], problem: Problem, state: State, lin: Linearisation, held: list[str],
    overlap: NDArray[np.float64],
) -> tuple[FrameReport, ...]:  # fmt: skip
    """Say how each frame fared; ``held`` gives the reason why a frame did not move, or is empty."""
    moved = se3.difference(state.T_map_camera, problem.T_map_camera)
    reports = []
    for i, frame_id in enumerate(ids):
        weights = lin.weights[i]
        reports.append(
            FrameReport(
                frame=frame_id,
                points=len(problem.frames[i]),
                overlap=float(np.delete(overlap[i], i).max(initial=0.0)),
                inliers=float((weights > 0.5).mean()) if len(weights) else 0.0,
                move_t=float(np.linalg.norm(moved[i, :3])),
                move_r=float(np.linalg.norm(moved[i, 3:])),
                held=held[i],
            )
        )
    return tuple(reports)


def depth_map(
    problem: Problem, level: Level, state: State, lin: Linearisation, sigma: float
) -> DepthMap:
    """Return the map at a state, with nodes that nothing saw left open; ``sigma`` in metres."""
    averages = average(problem, state.T_map_camera, level.grid)
    seen = near(averages.count > 0, 1) & (lin.C.own > 0)
    heights = np.where(seen, state.heights, np.nan)
    spread = np.where(seen, sigma / np.sqrt(lin.C.row_sums()), np.nan)
    return DepthMap(
        heights=heights,
        origin=(float(level.grid.origin[0]), float(level.grid.origin[1])),
        spacing=level.grid.spacing,
        T_map_world=problem.T_map_world,
        count=averages.count.astype(np.int64),
        sigma=spread,
    )


def iteration(
    p: Progress, level: Level, index: int, levels: int, phase: str, count: int,
    problem: Problem, seconds: float,
) -> Iteration:  # fmt: skip
    """Put one step of the solver into the form that callbacks and histories get."""
    weights = np.concatenate([w[:: max(1, len(w) // 5000)] for w in p.lin.weights])
    seen = near(level.averages.count > 0, 1)
    unknown = np.full(level.grid.shape, np.nan)
    turned = np.linalg.norm(p.step.pose[:, 3:], axis=1).max()
    return Iteration(
        index=count,
        level=index,
        levels=levels,
        spacing=level.grid.spacing,
        phase="robust" if phase == "robust" else "quadratic",
        cost=p.cost,
        step_t=float(np.linalg.norm(p.step.pose[:, :3], axis=1).max()),
        step_r=float(turned),
        damping=p.damping,
        accepted=p.accepted,
        inliers=float((weights > 0.5).mean()),
        sigma=p.sigma,
        cells=int(seen.sum()),
        seconds=seconds,
        T_world_camera=se3.inverse(problem.T_map_world) @ p.state.T_map_camera,
        depth_map=DepthMap(
            heights=np.where(seen, p.state.heights, np.nan),
            origin=(float(level.grid.origin[0]), float(level.grid.origin[1])),
            spacing=level.grid.spacing,
            T_map_world=problem.T_map_world,
            count=level.averages.count.astype(np.int64),
            sigma=unknown,
        ),
    )
