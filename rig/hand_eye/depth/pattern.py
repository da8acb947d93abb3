"""A fixed pattern of the camera: an error of the range that is the same in every frame.

It moves the scene alike in front of every camera, and so does a wrong hand-eye transform. The
pattern is therefore an unknown, a sum of the waves of :mod:`depthba.optimiser.waves`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.optimiser import coupling
from depthba.optimiser.level import Level
from depthba.optimiser.linearise import Linearisation, Loss, State, linearise
from depthba.optimiser.problem import Problem
from depthba.optimiser.workers import Workers

Array = NDArray[np.float64]

# How far points are moved to see what that does, m.
DELTA = 2e-4
# How much farther a wave may move a point, and which share of that a bend in its residual may be.
FAR = 3.0
LEAP = 0.1


@dataclass(frozen=True)
class Waves:
    """The waves at every point."""

    at: tuple[NDArray[np.float32], ...]
    """(n, m) per frame, by how much a unit of each moves the point along its ray, m at a point of
    typical noise; the farther and noisier points are moved by more."""

    @property
    def count(self) -> int:
        """How many waves there are."""
        return self.at[0].shape[1]

    def without(self, problem: Problem, pattern: Array) -> Problem:
        """Return the problem with the pattern (m,), m, taken off."""
        frames = []
        for frame, waves in zip(problem.frames, self.at, strict=True):
            points = frame.points.copy()
            error = waves @ pattern.astype(np.float32)
            away = np.linalg.norm(points[:, :3], axis=1)
            points[:, :3] *= (1 - error / np.maximum(away, 1e-6))[:, None]
            frames.append(replace(frame, points=points))
        return replace(problem, frames=tuple(frames))


def waves_of(problem: Problem) -> Waves:
    """Return the waves at the points of a problem; none where the rays are not known."""
    if problem.waves is None:
        return Waves(tuple(np.zeros((len(f), 0), np.float32) for f in problem.frames))
    return Waves(tuple(problem.waves.at(f.points) for f in problem.frames))


@dataclass(frozen=True)
class Answers:
    """How poses, map and residuals answer to the pattern."""

    back: NDArray[np.float32]
    """(m, ny, nx), the map's answer to a unit of each wave, sign reversed."""
    pull: tuple[NDArray[np.float32], ...]
    """(n,) per frame, share of each point times its residual's change with its range."""
    own: Array
    """(m, m), the pattern's own block, the map eliminated."""
    cross: Array
    """(6N, m), the coupling with the poses, the map eliminated."""

    def gradient(self, waves: Waves, lin: Linearisation) -> Array:
        """Return the pattern's gradient (m,), the map eliminated."""
        total = -np.tensordot(self.back, lin.g_map, 2)
        for at, pull, residual, weight in zip(
            waves.at, self.pull, lin.residuals, lin.weights, strict=True
        ):
            total = total + at.T @ (np.nan_to_num(residual) * weight * pull)
        return np.asarray(total, np.float64)


def answers(
    level: Level, state: State, loss: Loss, lin: Linearisation, waves: Waves, workers: Workers
) -> Answers:
    """Move all points along their rays wave by wave, with the robust weights held.

    A point that is moved along its ray keeps the foot on the map where its residual is taken, but
    for the walk there being cut short: both ways differ, and their mean is taken.
    """
    frozen = replace(loss, robust_c=0.0)

    def at(problem: Problem, waves: Waves, pattern: Array) -> Linearisation:
        moved = waves.without(problem, pattern)
        return linearise(moved, level.grid, state, frozen, workers, level.smooth)

    # all points moved alike, and far enough for every wave
    even = Waves(tuple(np.ones((len(f), 1), np.float32) for f in level.problem.frames))
    three = [at(level.problem, even, np.array([k * FAR * DELTA])) for k in (-1, 0, 1)]
    m = waves.count
    own = np.zeros((m, m))
    frames, pulls = [], []
    for wave, frame, weight, *residuals in zip(
        waves.at, level.problem.frames, lin.weights, *(one.residuals for one in three), strict=True
    ):
        before, here, after = (np.nan_to_num(r) for r in residuals)
        change = (after - before) / np.float32(2 * FAR * DELTA)
        bent = (after + before - 2 * here) / np.float32(2 * FAR * DELTA)
        # a point whose walk leaps to another foot has no derivative
        steady = (np.abs(change) < 1.1 * frame.points[:, 3]) & (
            np.abs(bent) < LEAP * frame.points[:, 3]
        )
        points = frame.points.copy()
        points[:, 4] *= weight * steady
        frames.append(replace(frame, points=points))
        pulls.append((frame.points[:, 4] * steady * change).astype(np.float32))
        own += wave.T @ ((points[:, 4] * change**2)[:, None] * wave)
    problem = replace(level.problem, frames=tuple(frames))
    pose = np.zeros((lin.g_pose.size, m))
    fields, back = (np.zeros((m, *lin.g_map.shape), np.float32) for _ in range(2))
    for k in range(m):
        minus, plus = (at(problem, waves, sign * DELTA * np.eye(m)[k]) for sign in (-1, 1))
        field = (plus.g_map - minus.g_map) / (2 * DELTA)
        answer, _ = lin.C.solve(field, 1e-4)
        fields[k], back[k] = field, answer
        coupled = (plus.g_pose - minus.g_pose) / (2 * DELTA) - coupling.gather(lin, answer)
        pose[:, k] = coupled.ravel()
    own -= np.tensordot(fields, back, ((1, 2), (1, 2)))
    return Answers(back, tuple(pulls), (own + own.T) / 2, pose)
