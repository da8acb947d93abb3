"""Maximum likelihood over X, Y, the lens and the flanges, pixels and robot each weighed by sigma.

Minimises ``sum |error|^2 / sigma_px^2 + sum missed^T Sigma^-1 missed`` and the prior's square by
Levenberg-Marquardt; what a flange missed is eliminated pose by pose (Schur complement), so a step
costs a matrix of what all poses share, and one of 6 x 6 a pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.hand_eye.board.chain import Chain, errors, linearise
from rig.hand_eye.board.noise import Noise, Prior
from rig.hand_eye.board.observations import Observations

Array = NDArray[np.float64]

STEPS = 60
# Settled when the step is below this many standard deviations, root mean square.
SETTLED = 1e-3


@dataclass(frozen=True, eq=False)
class Problem:
    """What is minimised."""

    observations: Observations
    velocity: Array
    """(N, 6), of the flanges, m/s and rad/s; 0 where they stand."""
    noise: Noise
    prior: Prior
    corner_weights: Array
    """(N, M), 0 where a corner was not found or is not believed."""
    pose_weights: Array
    """(N,), by which the robot's information about each pose is multiplied; 0 for a pose whose
    report is not believed."""

    def cost(self, chain: Chain) -> float:
        """Return the squared normalised errors; infinite where a point falls behind a camera."""
        error = errors(chain, self.observations, self.velocity)
        square = np.where(self.corner_weights > 0, np.square(error).sum(axis=-1), 0.0)
        if not np.isfinite(square).all():
            return float("inf")
        pixels = float((self.corner_weights * square).sum()) / self.noise.corner**2
        return pixels + self._held(chain)

    def _held(self, chain: Chain) -> float:
        sigma = self.prior.sigma(chain.shared)
        bound = np.isfinite(sigma) & (sigma > 0)
        held = float(np.square(chain.values()[bound] / sigma[bound]).sum())
        robot = (np.square(chain.missed) / self.noise.flange()).sum(axis=1)
        return held + float(self.pose_weights @ robot)


@dataclass(frozen=True, eq=False)
class Normal:
    """The normal equations about a chain, flanges apart."""

    H: Array
    """(s, s), information of pixels and prior on what is shared."""
    g: Array
    """(s,), gradient."""
    C: Array
    """(N, s, 6), coupling with each flange."""
    D: Array
    """(N, 6, 6), information on each flange, robot's included."""
    h: Array
    """(N, 6), gradient."""
    D_pixels: Array
    """(N, 6, 6), of the pixels alone."""
    free: NDArray[np.bool_]
    """(s,), what is not held fixed."""

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array, Array]:
        """Eliminate the flanges: the matrix (s, s), gradient (s,) and D^-1 [C^T, h] (N, 6, s + 1).

        Damping adds that share of the diagonals to both.
        """
        diagonal = np.einsum("nkk->nk", self.D)
        D = self.D + damping * np.einsum("nk,kl->nkl", diagonal, np.eye(6))
        solved = np.linalg.solve(
            D, np.concatenate([np.swapaxes(self.C, -1, -2), self.h[..., None]], axis=-1)
        )
        S = (
            self.H
            + damping * np.diag(np.diag(self.H))
            - np.einsum("nsk,nkt->st", self.C, solved[..., :-1])
        )
        g = self.g - np.einsum("nsk,nk->s", self.C, solved[..., -1])
        return (S + S.T) / 2, g, solved


@dataclass(frozen=True, eq=False)
class Solution:
    """The minimum."""

    chain: Chain
    problem: Problem
    normal: Normal
    cost: float
    converged: bool
    iterations: int

    @property
    def covariance(self) -> Array:
        """(s, s) of what is shared; 0 for what is held. Open directions get their huge variance."""
        return covariance(self.normal)

    def missed_covariance(self) -> Array:
        """(N, 6, 6), of what each flange missed."""
        _, _, solved = self.normal.reduced()
        back = solved[..., :-1]
        own = np.linalg.inv(self.normal.D)
        return np.asarray(own + back @ self.covariance @ np.swapaxes(back, -1, -2))


def pixel_blocks(
    chain: Chain, observations: Observations, velocity: Array, weights: Array
) -> Array:
    """Return the pixels' information of each pose (N, s + 7, s + 7).

    On what is shared, on the flange (6), and in the last row the gradient; weights (N, M) are the
    corners' over their variance.
    """
    error, J, J_pose = linearise(chain, observations, velocity)
    off = ~(weights > 0)
    error[off], J[off], J_pose[off] = 0.0, 0.0, 0.0
    both = np.concatenate([J, J_pose, error[..., None]], axis=-1)
    both = both.reshape(len(error), -1, chain.shared + 7)
    weighed = np.repeat(weights, 2, axis=1)[..., None] * both
    return np.asarray(np.swapaxes(both, -1, -2) @ weighed)


def normal_equations(problem: Problem, chain: Chain) -> Normal:
    """Set up the normal equations (half the cost's gradient) at a chain."""
    s = chain.shared
    w = problem.corner_weights / problem.noise.corner**2
    M = pixel_blocks(chain, problem.observations, problem.velocity, w)
    sigma = problem.prior.sigma(s)
    bound = np.isfinite(sigma) & (sigma > 0)
    information = np.zeros(s)
    information[bound] = 1 / sigma[bound] ** 2
    robot = problem.pose_weights[:, None] / problem.noise.flange()
    D_pixels = M[:, s : s + 6, s : s + 6]
    free = sigma > 0
    H = M[:, :s, :s].sum(axis=0) + np.diag(information)
    H[~free], H[:, ~free] = 0.0, 0.0
    H[~free, ~free] = 1.0
    g = np.where(free, M[:, :s, -1].sum(axis=0) + information * chain.values(), 0.0)
    return Normal(
        H=H,
        g=g,
        C=np.where(free[:, None], M[:, :s, s : s + 6], 0.0),
        D=D_pixels + np.einsum("nk,kl->nkl", robot, np.eye(6)),
        h=M[:, s : s + 6, -1] + robot * chain.missed,
        D_pixels=D_pixels,
        free=free,
    )


def covariance(normal: Normal) -> Array:
    """(s, s), the inverse of the reduced matrix; 0 for what is held."""
    S, _, _ = normal.reduced()
    inverse = inverse_of(S)
    inverse[~normal.free], inverse[:, ~normal.free] = 0.0, 0.0
    return inverse


def inverse_of(S: Array) -> Array:
    """Invert an information matrix; a direction without any gets a variance beyond all measure."""
    diagonal = np.diag(S)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(scale[:, None] * S * scale)
    values = np.maximum(values, 1e-13 * values[-1])
    return np.asarray(scale[:, None] * (vectors / values) @ vectors.T * scale)


def minimise(problem: Problem, chain: Chain, steps: int = STEPS) -> Solution:
    """Iterate from a chain until it settles."""
    cost, damping, converged, count = problem.cost(chain), 0.0, False, 0
    normal = normal_equations(problem, chain)
    while count < steps and np.isfinite(cost):
        count += 1
        # a trace of damping keeps still what no motion shows
        S, g, solved = normal.reduced(damping)
        step = -_solve(S, g)
        missed = -(solved[..., -1] + solved[..., :-1] @ step)
        candidate = chain.moved(step, missed)
        after = problem.cost(candidate)
        gain = float(-(g @ step)) - float((normal.h * missed).sum())
        small = abs(float(step @ normal.H @ step)) < SETTLED**2 * len(g)
        if after <= cost * (1 + 1e-12):
            small = small or cost - after < 1e-10 * cost
            chain, cost = candidate, after
            normal = normal_equations(problem, chain)
            damping = damping / 10 if damping > 1e-7 else 0.0
            if small and damping < 1e-3:
                converged = True
                break
        elif small or gain < 1e-9 * cost:
            converged = True
            break
        else:
            damping = max(10 * damping, 1e-4)
            if damping > 1e8:
                break
    return Solution(chain, problem, normal, cost, converged, count)


def _solve(S: Array, g: Array) -> Array:
    diagonal = np.diag(S)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    matrix = scale[:, None] * S * scale + 1e-12 * np.eye(len(S))
    return np.asarray(scale * np.linalg.solve(matrix, scale * g))
