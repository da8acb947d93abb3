"""The hand-eye transform from the poses of a registration.

A registration's covariance says whole what the depths know of the poses, relative to the first: the
map, its patches and the camera's fixed pattern are eliminated in it. X, the joints' zeros and the
flanges are fitted to the poses in its metric (generalised least squares).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.optimiser import dense
from depthba.result import Result
from rig.hand_eye.depth.believed import Beliefs, estimate
from rig.hand_eye.depth.chain import Chain

Array = NDArray[np.float64]

# Settled when the step of X is below this many of its standard deviations (root mean square).
SETTLED, STEPS = 0.01, 30


@dataclass(frozen=True)
class Start:
    """The transform to start from and how far off it may be."""

    T_flange_camera: Array
    """(4, 4)."""
    sigma: Array
    """(6,) m and rad."""

    def error(self, chain: Chain) -> Array:
        """Return (6,) by which the chain's transform has left the start."""
        return se3.difference(chain.T_flange_camera, self.T_flange_camera)


@dataclass(frozen=True)
class Seen:
    """Where depths saw the cameras, relative to the first."""

    T_world_camera: Array
    """(N, 4, 4)."""
    known: NDArray[np.int_]
    """(k,), the frames that were free to move; the first, to which all is relative, is not."""
    information: Array
    """(6k, 6k), of perturbations about the camera centres, world axes."""

    @classmethod
    def of(cls, result: Result) -> Seen:
        """Return what a registration without measured poses says."""
        held = np.array([bool(frame.held) for frame in result.frames])
        held[0] = True
        known = np.flatnonzero(~held)
        rows = (6 * known[:, None] + np.arange(6)).ravel()
        covariance = result.covariance[np.ix_(rows, rows)]
        return cls(result.T_world_camera, known, dense.inverse(covariance))


@dataclass(frozen=True)
class Fit:
    """The estimate and how certain it is."""

    chain: Chain
    beliefs: Beliefs
    covariance: Array
    """(k, k) of X, the joints' zeros and the flanges."""
    converged: bool


def fit(chain: Chain, seen: Seen, start: Start, stated: Beliefs) -> Fit:
    """Fit X, the joints' zeros and the flanges to the poses (Gauss-Newton).

    Args:
        chain: where to start.
        seen: the poses.
        start: the transform that was given, and how far off it may be.
        stated: the beliefs to begin with.
    """
    n, zeros = len(chain.missed), len(chain.zeros)
    converged = False
    for _ in range(STEPS):
        chain = put_first(chain, seen.T_world_camera[0])
        e, J = relative(chain, seen)
        seen_by = J.T @ seen.information
        now = np.concatenate([start.error(chain), chain.zeros, chain.missed.ravel()])
        beliefs, step, covariance = estimate(seen_by @ J, seen_by @ e, now, stated, zeros, n)
        chain = chain.moved(step)
        away = float(step[:6] @ np.linalg.solve(covariance[:6, :6], step[:6]))
        if away < 6 * SETTLED**2:
            converged = True
            break
    return Fit(put_first(chain, seen.T_world_camera[0]), beliefs, covariance, converged)


def put_first(chain: Chain, T_world_camera: Array) -> Chain:
    """Return the chain with its base placed so that the first camera stands as given (4, 4)."""
    moved = T_world_camera @ se3.inverse(chain.T_world_camera[0])
    return replace(chain, T_world_base=moved @ chain.T_world_base)


def relative(chain: Chain, seen: Seen) -> tuple[Array, Array]:
    """Return by how much the known cameras are off (6k,), and its derivative (6k, unknowns).

    Both with the first camera, which stands as it was seen, brought back to where it was.
    """
    T = chain.T_world_camera
    e = se3.difference(T, seen.T_world_camera)[seen.known].ravel()
    J = chain.jacobian().reshape(len(T), 6, -1)
    along = np.tile(np.eye(6), (len(seen.known), 1, 1))
    along[:, :3, 3:] = -se3.hat(T[seen.known, :3, 3] - T[0, :3, 3])
    return e, (J[seen.known] - along @ J[0]).reshape(len(e), J.shape[-1])
