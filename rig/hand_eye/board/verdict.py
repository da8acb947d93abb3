"""Whether to rely on a calibration with a board, said before any number."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from depthba.optimiser.certainty import direction_name
from rig.hand_eye.board.chain import CLOCK, LENS, SIZE, X
from rig.hand_eye.board.estimate import UNLIKELY, Estimate
from rig.hand_eye.board.noise import Prior
from rig.hand_eye.board.refine import Solution, minimise
from rig.hand_eye.board.views import displacement
from rig.hand_eye.flanges import motion_fault, turned
from rig.hand_eye.record import OPEN_R, OPEN_T, Open

Array = NDArray[np.float64]

Status = Literal["converged", "not_converged", "weak", "inconsistent"]
"""``converged``: done, to be trusted. ``not_converged``: stopped at a limit. ``weak``: done, but
the motions leave X, or part of it, open. ``inconsistent``: poses, images and board do not belong
together."""

# A robot that misses by more than this, m and rad, is no robot: the poses are others'. The board
# is looser: its errors of pose are the camera's.
HOPELESS_T, HOPELESS_R = 0.005, 0.01
# Corners that miss by more than this, px, are of another camera or another board.
HOPELESS_CORNER = 3.0
# A size or a clock is off when it is this many of its standard deviations away, and worth a
# word from here on: a share, s, and a share of the focal length or of the image's width.
CERTAIN = 5.0
# How far the camera is let go, as a share, to see whether it is the one that was stated.
LOOSE = 0.01
# Turns about a second axis (root mean square, rad) below which noise passes for knowledge.
LITTLE = float(np.radians(3.0))
LENS_MATTERS = 0.0005
# By what shares of what the prior allows given numbers of a camera may be off.
DOUBTS = (0.0, 0.1, 0.3, 1.0)
SIZE_MATTERS, CLOCK_MATTERS = 0.003, 0.001


@dataclass(frozen=True, eq=False)
class Tested:
    """A number that is taken for right, and what the data say when it is left free."""

    value: float
    sigma: float

    def off(self, matters: float) -> bool:
        """Tell whether it is certainly off, and by enough to matter."""
        return abs(self.value) > max(CERTAIN * self.sigma, matters)


@dataclass(frozen=True, eq=False)
class Verdict:
    """What is to be thought of the estimate."""

    status: Status
    reason: str
    open: tuple[Open, ...]
    covariance: Array
    """(6, 6), of X; what is open is as uncertain there as before the calibration."""
    size: Tested | None
    """Log of the board's size; None: not to be told from these data."""
    conditioning: float
    """The largest of X's standard deviations over the smallest, as displacements of points at the
    board."""


def tested_size(solution: Solution) -> Tested | None:
    """Leave the board's size free: the robot measures it."""
    return _tested(solution, replace(solution.problem.prior, size=1.0), SIZE)


def tested_clock(solution: Solution) -> Tested | None:
    """Leave the clock free where the flanges were moving."""
    if not np.abs(solution.problem.velocity).max() > 0:
        return None
    return _tested(solution, replace(solution.problem.prior, clock=1.0), CLOCK)


def lens_fault(solution: Solution) -> str:
    """Say by how much the images want another camera than was believed; empty where they do not.

    The focal lengths and the centre are let go ten times as far as a calibrated camera may be off.
    """
    believed = np.array(solution.problem.prior.lens[:4])
    if believed[0] > LOOSE:  # the camera was estimated from these images
        return ""
    width = solution.problem.observations.camera.width
    loose = (LOOSE, LOOSE / 5, LOOSE * width, LOOSE * width, *solution.problem.prior.lens[4:])
    free = minimise(
        replace(solution.problem, prior=replace(solution.problem.prior, lens=loose)),
        solution.chain,
        20,
    )
    off = free.chain.lens[:4]
    C = free.covariance[LENS, LENS][:4, :4] + np.diag(believed**2)
    scale = np.sqrt(np.diag(C))
    distance = off / scale @ np.linalg.solve(C / np.outer(scale, scale), off / scale)
    matters = np.array([LENS_MATTERS, LENS_MATTERS, *np.full(2, LENS_MATTERS * width)])
    if distance < chi2.isf(UNLIKELY, 4) or not (np.abs(off) > matters).any():
        return ""
    return (
        f"the images are of another camera than stated: focal length {100 * off[0]:+.2f} %, centre"
        f" {off[2]:+.1f} {off[3]:+.1f} px; expected its own numbers, or another of --intrinsics"
    )


def camera_doubt(solution: Solution) -> float:
    """Return by how much the camera is to be doubted, as a share of what the prior allows, 0 to 1.

    How wrong given numbers usually are nobody knows: they may be exact. Each of `DOUBTS` is a prior
    as narrow, all alike before; each is worth its evidence, the density that it gave to what the
    images say (MacKay 1992), by the normal approximation to that. Returned is the root mean square.
    """
    sigma = np.array(solution.problem.prior.lens)
    bound = np.flatnonzero(sigma > 0)
    rows = LENS.start + bound
    C = solution.covariance[np.ix_(rows, rows)] / np.outer(sigma[bound], sigma[bound])
    # what the images alone say: its precision along its axes, and times where it lies
    values, axes = np.linalg.eigh(C)
    precision = np.maximum(1.0 / values - 1.0, 0.0)
    pull = (axes.T @ (solution.chain.lens[bound] / sigma[bound])) / values
    square = np.square(DOUBTS)[:, None]
    narrowed = 1.0 + square * precision
    log = 0.5 * (square * pull**2 / narrowed - np.log(narrowed)).sum(axis=1)
    weight = np.exp(log - log.max())
    return float(np.sqrt(weight @ np.square(DOUBTS) / weight.sum()))


def _tested(solution: Solution, prior: Prior, index: int) -> Tested | None:
    problem = replace(solution.problem, prior=prior)
    free = minimise(problem, solution.chain, 20)
    sigma = float(np.sqrt(free.covariance[index, index]))
    if sigma > 0.3:
        return None
    return Tested(float(free.chain.values()[index]), sigma)


def open_directions(covariance: Array) -> tuple[Open, ...]:
    """Return the directions (6,) of X whose standard deviation is of no use."""
    scale = np.repeat([OPEN_T, OPEN_R], 3)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return tuple(
        Open(direction_name(vector), vector * scale * float(np.sqrt(value)), 1.0)
        for value, vector in zip(values[::-1], vectors.T[::-1], strict=True)
        if value > 1.0
    )


def honest(covariance: Array, left_open: tuple[Open, ...], reach: float) -> Array:
    """Return the covariance (6, 6), what is open as uncertain as before.

    Where no motion shows a direction, noise does, and seems to tell something.
    """
    whole = covariance.copy()
    for direction in left_open:
        size = np.array([*np.full(3, reach), *np.full(3, np.pi)])
        unit = direction.direction / float(np.linalg.norm(direction.direction / size))
        whole += np.outer(unit, unit)
    return whole


def conditioning(covariance: Array, distance: float) -> float:
    """Return the largest over the smallest of X's standard deviations, scaled by the distance."""
    scale = np.repeat([1.0, 1.0 / max(distance, 1e-3)], 3)
    values = np.linalg.eigvalsh(covariance / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / max(values[0], 1e-300)))


def judge(found: Estimate, board: float, distance: float, reach: float) -> Verdict:
    """Say what the estimate is worth.

    Args:
        found: the estimate.
        board: side of the board's squares or what stands for its size, m, for people.
        distance: m, from the cameras to the board.
        reach: m, how far X's camera may be from X's frame.
    """
    solution, noise = found.solution, found.solution.problem.noise
    covariance = solution.covariance[X, X]
    left_open = open_directions(covariance)
    size = tested_size(solution)
    how = conditioning(covariance, distance)
    kept = ~found.dropped
    observations = solution.problem.observations
    fault = motion_fault(observations.T_base_flange[kept])

    def verdict(status: Status, reason: str) -> Verdict:
        return Verdict(status, reason, left_open, honest(covariance, left_open, reach), size, how)

    if noise.corner > HOPELESS_CORNER:
        return verdict(
            "inconsistent",
            f"the corners miss by {noise.corner:.1f} px: the camera's numbers or the board's layout"
            " are not those of these images",
        )
    if noise.robot_t > HOPELESS_T or noise.robot_r > HOPELESS_R:
        return verdict(
            "inconsistent",
            "the flange poses do not fit the images: they miss by "
            f"{1e3 * noise.robot_t:.1f} mm and {np.degrees(noise.robot_r):.2f} degrees",
        )
    little = turned(observations.T_base_flange[kept])[0][1]
    if not fault and little < LITTLE:
        fault = (
            f"the flange turned by only {np.degrees(little):.1f} degrees about its second axis,"
            f" expected {np.degrees(LITTLE):.0f} or more"
        )
    if fault or left_open:
        names = ", ".join(o.name for o in left_open)
        parts = [fault] if fault else []
        if names:
            sigma = displacement(covariance, distance)
            parts.append(
                f"the motions leave open, in flange axes: {names} (a point at the board is "
                f"uncertain by {_shown(sigma)})"
            )
        return verdict("weak", "; ".join(parts))
    if kept.sum() < 0.6 * len(kept):
        return verdict(
            "inconsistent",
            f"only {kept.sum()} of {len(kept)} poses agree with one another",
        )
    if size is not None and size.off(SIZE_MATTERS):
        actual = board * np.exp(size.value)
        return verdict(
            "inconsistent",
            f"by the robot the board's squares are {1e3 * actual:.2f} mm (sigma"
            f" {1e3 * actual * size.sigma:.2f}), not {1e3 * board:.2f} mm: measure them, or the"
            " camera's focal length is wrong",
        )
    if lens := lens_fault(solution):
        return verdict("inconsistent", lens)
    if not solution.converged:
        return verdict("not_converged", "the iterations ended before the transform settled")
    return verdict("converged", "the motions fix the transform")


def _shown(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm" if metres < 1.0 else "more than a metre"
