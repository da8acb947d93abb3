"""The fixed pattern of the camera, solved for along with poses and map.

A pattern moves the scene alike in front of every camera: frames that look at one place from
different sides cannot be made to agree, and lean to where they disagree least. Its waves are
unknowns like the poses. Map and poses are eliminated from their normal equations; their strength
is what makes the data most probable (empirical Bayes, MacKay 1992), so that a camera without a
pattern gets none.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba.compiling import kernel
from depthba.optimiser import dense
from depthba.optimiser.asking import look
from depthba.optimiser.feet import Feet, Ground
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import Linearisation, Loss, State
from depthba.optimiser.map_solver import MapSolver
from depthba.optimiser.patch_waves import Told
from depthba.optimiser.problem import FramePoints, Problem
from depthba.optimiser.reduced import Reduction
from depthba.optimiser.waves import Waves
from depthba.optimiser.workers import Workers

Array = NDArray[np.float64]

# Relative residual of the map's answers to the waves.
TOLERANCE = 1e-2
# Factor on the variance of the residuals. Outlines, and noise that neighbours share, pull the waves
# that the data hold least by several of the deviations that independent residuals would have.
CAUTION = 12.0
# Share of the best known direction's information, below which nothing is known of a direction.
KNOWN = 1e-9
# Strengths that are tried, from this share of the least that shows to its inverse of the largest.
FAINT, TRIED = 0.1, 200
# How much more probable a pattern must make the data, twice the logarithm.
WORTH = 10.0


def without(problem: Problem, pattern: Array) -> Problem:
    """Return the problem with a pattern (m,), m at a point of typical noise, taken off."""
    waves = problem.waves
    if waves is None:
        return problem
    frames = []
    for frame in problem.frames:
        points = frame.points.copy()
        error = waves.at(points) @ pattern.astype(np.float32)
        away = np.linalg.norm(points, axis=1)
        points *= (1 - error / np.maximum(away, 1e-6))[:, None]
        frames.append(replace(frame, points=points))
    return replace(problem, frames=tuple(frames))


@dataclass(frozen=True)
class Share:
    """What the waves do to the points of a frame."""

    waves: NDArray[np.float32]
    """(n, m)."""
    change: NDArray[np.float32]
    """(n,), of the vertical residual with the range."""
    weight: NDArray[np.float32]
    """(n,), of the squared vertical residual; 0 where it does not count."""


@dataclass(frozen=True)
class Answers:
    """The normal equations of the pattern, the map eliminated."""

    own: Array
    """(m, m), block of the pattern itself."""
    cross: Array
    """(6N, m), coupling with the poses."""
    gradient: Array
    """(m,)."""
    map: NDArray[np.float32]
    """(ny, nx, m), by how much the map falls with a unit of each wave."""
    surfaces: Array | None = None
    """(k, 6, m), by how much patches beside the map move with a unit of each; None: none are."""

    def beside(self, told: Told) -> Answers:
        """Return the same with what patches say."""
        return Answers(
            self.own + told.own, self.cross + told.cross, self.gradient + told.gradient, self.map,
            told.surfaces,
        )  # fmt: skip


def share_of(frame: FramePoints, feet: Feet, weights: NDArray[np.float32], waves: Waves) -> Share:
    """Return what the waves do to the points of a frame, where they meet the map."""
    (x, y, z), (gx, gy) = feet.arms, feet.slopes
    away = np.sqrt(x * x + y * y + z * z)
    change = (z - gx * x - gy * y) / np.maximum(away, 1e-9)
    counts = (feet.on > 0) & (weights > 0) & np.isfinite(change)
    own, part = frame.inverse_noise.astype(float), frame.share
    weight = np.where(counts, part * weights * own**2 / np.where(counts, feet.norm2, 1.0), 0.0)
    change = np.where(counts, change, 0.0)
    return Share(waves.at(frame.points), change.astype(np.float32), weight.astype(np.float32))


def answers(
    problem: Problem,
    grid: Grid,
    state: State,
    loss: Loss,
    lin: Linearisation,
    at: Reduction,
    waves: Waves,
    workers: Workers,
) -> Answers:
    """Set up the normal equations of the pattern and eliminate the map from them.

    Args:
        problem: the points.
        grid: where the nodes stand.
        state: poses and heights.
        loss: the residual.
        lin: its linearisation, whose robust weights are held.
        at: its map eliminated.
        waves: what the pattern is made of.
        workers: the threads.
    """
    m, count = len(waves), len(problem.frames)
    ground = Ground(problem, grid, state, loss)
    fields = np.zeros((*grid.shape, m), np.float32)
    own, gradient, cross = np.zeros((m, m)), np.zeros(m), np.zeros((count, 6, m))

    def part(i: int) -> tuple[Feet, Share]:
        # errors of the range move points against their residual's change: hence the minus signs
        frame, feet = problem.frames[i], ground.feet(i)
        share = share_of(frame, feet, lin.weights[i], waves)
        pull = share.weight * share.change
        J = _jacobian(feet, state.T_map_camera[i, :3, 3] - lin.pivots[i])
        cross[i] = -np.where(share.weight > 0, J * pull, 0.0).astype(np.float32) @ share.waves
        return feet, share

    halves = [slice(k * m // 2, (k + 1) * m // 2) for k in range(2)]
    for first in range(0, count, 2):
        few = range(first, min(first + 2, count))
        for feet, share in workers.map(part, few):
            pull = share.weight * share.change
            own += (share.waves * (pull * share.change)[:, None]).T @ share.waves
            residuals = np.where(share.weight > 0, feet.residuals, 0.0).astype(np.float32)
            gradient -= (pull * residuals) @ share.waves

            def spread(half: slice, feet: Feet = feet, share: Share = share) -> None:
                _spread(
                    feet.cells, feet.fractions, share.weight * share.change,
                    np.ascontiguousarray(share.waves[:, half]), fields[:, :, half],
                )  # fmt: skip

            workers.map(spread, halves)
    for i, reply in enumerate(at.answers):
        inner = np.ascontiguousarray(fields[reply.window]).reshape(-1, m)
        cross[i] -= reply.values.reshape(-1, 6).T @ inner
    solver, found = MapSolver(lin.C, TOLERANCE), np.empty_like(fields)

    def answer(k: int) -> None:
        field = fields[:, :, k].astype(np.float64)
        found[:, :, k], _ = solver.solve(field, TOLERANCE)
        # the solves are loose, the product is not: with what a solve leaves added to the field its
        # error is of second order in the tolerance
        fields[:, :, k] += field - lin.C.times(found[:, :, k].astype(np.float64))

    workers.map(answer, range(m))
    look()
    replies = found.reshape(-1, m)
    through = fields.reshape(-1, m).T @ replies
    own -= (through + through.T) / 2
    gradient -= lin.g_map.ravel().astype(np.float32) @ replies
    return Answers((own + own.T) / 2, cross.reshape(-1, m), gradient, found)


def scores(
    ground: Ground,
    lin: Linearisation,
    waves: Waves,
    found: Answers,
    groups: list[NDArray[np.uint8]],
    count: int,
    workers: Workers,
) -> Array:
    """Return the reduced gradient of each group of points, (kinds, groups, m).

    As :func:`depthba.optimiser.certainty.block_scores` does for the poses.
    """
    problem = ground.problem

    def of(frames: range) -> Array:
        total = np.zeros((len(groups[0]), count, len(waves)))
        for i in frames:
            frame = problem.frames[i]
            if not len(frame):
                continue
            feet = ground.feet(i)
            share = share_of(frame, feet, lin.weights[i], waves)
            pulls = share.weight * np.where(share.weight > 0, feet.residuals, 0.0)
            _scores(
                feet.cells, feet.fractions, pulls, share.change, share.waves, found.map, groups[i],
                total,
            )  # fmt: skip
        return total

    return np.asarray(sum(workers.map(of, workers.shares(problem)), start=np.zeros((1, 1, 1))))


@dataclass(frozen=True)
class Believed:
    """Where data and beliefs put the pattern, and how little it is known."""

    pattern: Array
    """(m,), m at a point of typical noise."""
    strength: float
    """Standard deviation of a wave, m at a point of typical noise; 0: there is no pattern."""
    found: Answers
    inverse: Array
    """(m, m), the pattern's covariance, poses held, over the variance of a residual."""
    gain: Array
    """(6N,), by how much the poses follow from the present pattern to this one."""

    def eliminated(self, S: Array) -> Array:
        """Return S (6N, 6N) with the pattern eliminated."""
        X = self.found.cross
        return np.asarray(S - X @ self.inverse @ X.T)

    def follow(self, scores: Array) -> Array:
        """Return what gradients of the pattern (..., m) add to the poses' own, (..., 6N)."""
        return np.asarray(-scores @ self.inverse @ self.found.cross.T)


def believe(
    found: Answers,
    held: Array,
    keep: NDArray[np.bool_],
    now: Array,
    variance: float,
) -> Believed:
    """Find how strong the waves are, and where that puts them.

    Args:
        found: their normal equations, the map eliminated.
        held: (6N, 6N) what holds the poses, the measured ones included. They balance what the
            points say: no gradient is left.
        keep: (6N,), the poses that move.
        now: (m,) the present pattern.
        variance: m^2, of a residual, with what makes up for its errors not being independent.
    """
    cross = found.cross[keep]
    S = held[np.ix_(keep, keep)]
    S = S + np.diag(1e-9 * np.diag(S) + 1e-300)
    follow = dense.solved(S, cross)
    H = (found.own - cross.T @ follow) / variance
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    known = values > KNOWN * values[-1]
    values = np.where(known, values, 0.0)
    # every eigenvector is judged by itself: what the data say it is, and how surely
    pull = vectors.T @ found.gradient / variance
    call = np.where(known, values * (vectors.T @ now) - pull, 0.0)
    strength = _strength(values[known], call[known])
    pattern = vectors @ (strength**2 / (1 + strength**2 * values) * call)
    share = strength**2 / variance
    inverse = np.asarray(share * np.linalg.inv(share * found.own + np.eye(len(now))), np.float64)
    gain = np.zeros(len(keep))
    gain[keep] = -follow @ (pattern - now)
    return Believed(pattern, strength, found, inverse, gain)


def _strength(values: Array, call: Array) -> float:
    """Return the standard deviation of the waves that makes the data most probable; 0 where none.

    Args:
        values: (k,) information on each.
        call: (k,) of expectation ``values * wave`` and variance ``values``.
    """
    if not len(values):
        return 0.0
    tried = np.geomspace(FAINT / np.sqrt(values[-1]), 1 / FAINT / np.sqrt(values[0]), TRIED)
    spread = values + np.outer(tried**2, values**2)
    unlikely = (np.log(spread) + call**2 / spread).sum(axis=1)
    best = int(np.argmin(unlikely))
    without = float((np.log(values) + call**2 / values).sum())
    return float(tried[best]) if unlikely[best] < without - WORTH else 0.0


def _jacobian(feet: Feet, arm: Array) -> Array:
    """Return (6, n), the derivative of the vertical residual by the frame's perturbation."""
    lx, ly, lz = feet.arms + arm[:, None]
    gx, gy = feet.slopes
    return np.stack([-gx, -gy, np.ones_like(gx), ly + lz * gy, -lz * gx - lx, -lx * gy + ly * gx])


@kernel
def _spread(cells, fractions, pulls, waves, fields):
    """Add every point's pull times its waves (n, m) to its cell's nodes of ``fields``."""
    m = waves.shape[1]
    for k in range(pulls.shape[0]):
        if pulls[k] == 0.0:
            continue
        a, b = fractions[0, k], fractions[1, k]
        x, y = cells[0, k], cells[1, k]
        shares = ((1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b)
        for corner in range(4):
            e = np.float32(shares[corner] * pulls[k])
            node = fields[y + corner // 2, x + corner % 2]
            for j in range(m):
                node[j] += e * waves[k, j]


@kernel
def _scores(cells, fractions, pulls, change, waves, answers, groups, scores):
    """Add what every point adds to the pattern's reduced gradient to ``scores``, by its groups."""
    m = waves.shape[1]
    v = np.empty(m)
    for k in range(pulls.shape[0]):
        if pulls[k] == 0.0:
            continue
        a, b = fractions[0, k], fractions[1, k]
        x, y = cells[0, k], cells[1, k]
        for j in range(m):
            h = (1 - b) * ((1 - a) * answers[y, x, j] + a * answers[y, x + 1, j])
            h += b * ((1 - a) * answers[y + 1, x, j] + a * answers[y + 1, x + 1, j])
            v[j] = pulls[k] * (h - change[k] * waves[k, j])
        for kind in range(groups.shape[0]):
            row = scores[kind, groups[kind, k]]
            for j in range(m):
                row[j] += v[j]
