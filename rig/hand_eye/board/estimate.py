"""The estimate: X with the strength of both noises, without what does not belong to the rest.

First with heavy tails (a Student t for each flange, Geman-McClure for corners), then, what proved
bad left out, by plain maximum likelihood. The noises are found along with it as variance components
(MacKay 1992): squares over the number of parameters that the data determine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from depthba import se3
from depthba.errors import OptionError
from rig.hand_eye.board.begin import Beginning
from rig.hand_eye.board.chain import Chain, errors
from rig.hand_eye.board.noise import Noise, Prior
from rig.hand_eye.board.observations import Observations
from rig.hand_eye.board.refine import Problem, Solution, minimise

Array = NDArray[np.float64]

ROUNDS = 30
# The noises have settled when they change by less than this share.
SETTLED = 0.005
# What is stated of the robot counts as much as this many poses.
STATED = 1.0
# Degrees of freedom of the heavy tails, and where corners lose weight, in standard deviations.
TAILS = 5.0
CORNER = 4.0
# Corners farther off than this many standard deviations are left out, and poses that so few good
# ones would beat (probability under all others).
FAR_CORNER = 5.0
UNLIKELY = 1e-5
# Nothing is found better than this, px, m and rad: an estimate of 0 would forbid all else.
LEAST = Noise(0.005, 1e-6, 1e-6)


@dataclass(frozen=True)
class Stated:
    """What the user states of the noises."""

    robot: tuple[float, float]
    """m and rad."""
    fixed: bool
    """Whether the robot's noise is taken as stated; else it is found, begun there."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """The solution and what was left out of it."""

    solution: Solution
    stated: Stated
    distance: Array
    """(N,), squared normalised distance of each flange from where all other poses and its own
    picture put it: chi-squared with 6 degrees of freedom."""
    dropped: NDArray[np.bool_]
    """(N,), poses whose flange is not believed."""
    corners: Array
    """(N,), px, root mean square of each picture's residuals over coordinates, kept corners."""

    @property
    def spoilt(self) -> NDArray[np.bool_]:
        """(N,), pictures of which most corners fit nothing, so that none is believed."""
        return np.asarray(~(self.solution.problem.corner_weights > 0).any(axis=1))

    @property
    def X(self) -> Array:
        """(4, 4)."""
        return self.solution.chain.X

    @property
    def covariance(self) -> Array:
        """(6, 6), of X, m and rad, left perturbation."""
        return self.solution.covariance[:6, :6]


def estimate(
    observations: Observations,
    beginning: Beginning,
    P: Array,
    prior: Prior,
    stated: Stated,
) -> Estimate:
    """Estimate X and everything beside it.

    Args:
        observations: N poses.
        beginning: where to start.
        P: (N, 4, 4), T_camera_board of each picture alone.
        prior: of lens, size, clock and zeros.
        stated: of the noises.
    """
    n = len(observations)
    velocity = observations.speed
    joints = observations.joints
    count = 0 if joints is None or prior.zero == 0 else joints.shape[-1]
    if count == 0:
        observations = replace(observations, joints=None)
    chain = Chain(
        X=beginning.X, Y=beginning.Y, missed=_missed(observations, beginning, P),
        lens=np.zeros(9), size=0.0, clock=0.0, zeros=np.zeros(count),
    )  # fmt: skip
    seen = observations.seen
    noise = Noise(_first_sigma(chain, observations, velocity), *stated.robot)
    problem = Problem(
        observations, velocity, noise, prior, seen.astype(float), _tails(chain, noise)
    )
    solution = _settle(problem, chain, stated, heavy=True)
    kept = seen & (_lengths(solution) <= FAR_CORNER * solution.problem.noise.corner)
    kept &= (kept.sum(axis=1) >= 0.5 * seen.sum(axis=1))[:, None]  # else the picture is spoilt
    if not kept.any():
        raise OptionError("no corner fits any pose, expected corners of one board")
    pictured = kept.any(axis=1)  # of the others nothing is left but the robot's word
    dropped = _too_far(solution) & pictured
    for _ in range(3):
        problem = replace(
            solution.problem,
            corner_weights=kept.astype(float),
            pose_weights=np.where(dropped, 0.0, 1.0),
        )
        solution = _settle(problem, solution.chain, stated, heavy=False)
        distance = distances(solution)
        worse = (distance > chi2.isf(UNLIKELY, 6)) & pictured
        if (worse == dropped).all() or (~worse).sum() < max(3, n // 2):
            break
        dropped = worse
    dropped = solution.problem.pose_weights == 0
    square = np.where(kept, np.square(_lengths(solution)), 0.0).sum(axis=1)
    corners = np.sqrt(square / np.maximum(2 * kept.sum(axis=1), 1))
    return Estimate(solution, stated, distances(solution), dropped, corners)


def distances(solution: Solution) -> Array:
    """(N,), how far each flange is from where the others and its picture put it.

    The robot's word on a pose is taken out of the posterior (its cavity), then compared with it.
    """
    noise = solution.problem.noise.flange()
    C = solution.missed_covariance()
    m = solution.chain.missed
    own = solution.problem.pose_weights[:, None, None] * np.diag(1 / noise)
    scale = np.sqrt(noise)
    inner = np.linalg.inv(C) - own
    # scaled by the noise, so that metres and radians do not spoil the inversion
    V = np.linalg.inv(scale[:, None] * inner * scale + 1e-12 * np.eye(6))
    there = (V @ (scale[:, None] * np.linalg.inv(C) @ m[..., None]))[..., 0]
    return np.asarray(np.einsum("nk,nkl,nl->n", there, np.linalg.inv(V + np.eye(6)), there))


def _missed(observations: Observations, beginning: Beginning, P: Array) -> Array:
    """(N, 6), by which flanges that are not believed are elsewhere, by their pictures; else 0."""
    G = beginning.X @ P @ se3.inverse(beginning.Y)
    T = se3.inverse(G) if observations.mount == "eye-in-hand" else G
    off = se3.difference(T, observations.T_base_flange)
    return np.where(beginning.good[:, None], 0.0, off)


def _first_sigma(chain: Chain, observations: Observations, velocity: Array) -> float:
    """Px, robust, of the corners at the start, at least a plausible 0.1."""
    error = np.abs(errors(chain, observations, velocity))
    return max(0.1, 1.4826 * float(np.nanmedian(error)))


def _lengths(solution: Solution) -> Array:
    """(N, M), px, of the residuals; infinite where there is none."""
    problem = solution.problem
    error = errors(solution.chain, problem.observations, problem.velocity)
    square = np.square(error).sum(axis=-1)
    return np.where(np.isfinite(square), np.sqrt(np.where(np.isfinite(square), square, 0)), np.inf)


def _tails(chain: Chain, noise: Noise) -> Array:
    """(N,), weights of a multivariate Student t."""
    return np.asarray((TAILS + 6) / (TAILS + (np.square(chain.missed) / noise.flange()).sum(1)))


def _settle(problem: Problem, chain: Chain, stated: Stated, heavy: bool) -> Solution:
    """Alternate between the unknowns and the noises (and weights, with heavy tails)."""
    seen = problem.corner_weights > 0
    for _ in range(ROUNDS):
        solution = minimise(problem, chain)
        chain, before = solution.chain, problem.noise
        noise = _noises(solution, stated)
        problem = replace(problem, noise=noise)
        if heavy:
            far = _lengths(solution) / (CORNER * noise.corner)
            problem = replace(
                problem,
                corner_weights=np.where(seen, 1 / (1 + np.minimum(far, 1e6) ** 2) ** 2, 0.0),
                pose_weights=_tails(chain, noise),
            )
        change = [
            abs(np.log(getattr(noise, k) / getattr(before, k)))
            for k in ("corner", "robot_t", "robot_r")
        ]
        if max(change) < SETTLED:
            break
    return minimise(problem, chain)


def _noises(solution: Solution, stated: Stated) -> Noise:
    problem, chain = solution.problem, solution.chain
    n = len(chain.missed)
    flange = problem.noise.flange()
    u = problem.pose_weights[:, None]
    variance = np.einsum("nkk->nk", solution.missed_covariance())
    # numbers that the pixels determine, of the flanges and of what is shared
    determined = 1 - u * variance / flange
    sigma = problem.prior.sigma(chain.shared)
    bound = np.isfinite(sigma) & (sigma > 0)
    total = float(determined.sum()) + float(np.isinf(sigma).sum())
    total += float((1 - np.diag(solution.covariance)[bound] / sigma[bound] ** 2).sum())
    lengths = np.where(problem.corner_weights > 0, _lengths(solution), 0.0)
    square = float((problem.corner_weights * np.square(lengths)).sum())
    count = 2 * float((problem.corner_weights > 0).sum())
    corner = np.sqrt(square / max(count - total, 0.1 * count))
    if stated.fixed:
        robot = np.array(stated.robot)
    else:
        believed = (u[:, 0] > 0)[:, None]
        square = (u * np.square(chain.missed)).reshape(n, 2, 3).sum(axis=(0, 2))
        freedom = np.clip(np.where(believed, determined, 0.0), 0, 1).reshape(n, 2, 3).sum((0, 2))
        prior = 3 * STATED * np.square(stated.robot)
        robot = np.sqrt((square + prior) / (freedom + 3 * STATED))
    return Noise(
        max(float(corner), LEAST.corner),
        max(float(robot[0]), LEAST.robot_t),
        max(float(robot[1]), LEAST.robot_r),
    )


def _too_far(solution: Solution) -> NDArray[np.bool_]:
    """(N,), poses that the heavy tails have all but given up, at most half of all."""
    far = distances(solution) > chi2.isf(UNLIKELY, 6) * 1.5
    return far if far.sum() <= len(far) // 2 else np.zeros(len(far), bool)
