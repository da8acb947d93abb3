"""Bundle adjustment of landmarks that frames see as points in space.

Landmark l is seen by frame i at p: the residual is ``r = R p + t - l``, m, in world axes, where it
is as long as in the sensor's. Under Huber's loss, by iteratively reweighted Levenberg-Marquardt.
A pose moves by ``[tau, phi]`` as in `depthba.se3`, so that ``dr = A [tau, phi] - dl`` with
``A = [I, -hat(R p)]``.

Landmarks are eliminated block by block (the Schur complement; Triggs, McLauchlan, Hartley and
Fitzgibbon, "Bundle Adjustment - A Modern Synthesis", 2000): their blocks are multiples of the unit
matrix, ``W I`` with W the sum of a landmark's weights.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from depthba import se3
from eval.methods.tracks import Floats, Tracks

STILL = 1e-10
"""Steps below this, m and rad, are none."""


@dataclass(frozen=True)
class LandmarkOptions:
    """The loss and the schedule."""

    huber: float
    """Residual beyond which the loss grows linearly, m."""
    iterations: int = 100
    """At most, steps turned down included."""
    tolerance: float = 1e-9
    """Relative fall of the cost at which to stop."""
    damping: float = 1e-4
    """At the start, times the diagonal."""


@dataclass(frozen=True, eq=False)
class LandmarkSolution:
    """Poses and landmarks together."""

    T_world_camera: Floats
    """(N, 4, 4)."""
    landmarks: Floats
    """(L, 3), world, m."""
    cost: float
    """Sum of Huber's losses, r²/2 where r is small, m²."""
    iterations: int
    converged: bool


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The residuals to first order, ``r + A [tau, phi] - dl``, and what each counts."""

    weight: Floats
    """(k,) of each observation."""
    A: Floats
    """(k, 3, 6), derivatives of the residuals in the pose that made each."""
    residual: Floats
    """(k, 3), m."""


def residuals(tracks: Tracks, T_world_camera: Floats, landmarks: Floats) -> Floats:
    """Return (k, 3), m, world axes."""
    T = T_world_camera[tracks.frame]
    seen = np.einsum("kij,kj->ki", T[:, :3, :3], tracks.points) + T[:, :3, 3]
    return np.asarray(seen - landmarks[tracks.track])


def linearise(
    tracks: Tracks, T_world_camera: Floats, landmarks: Floats, huber: float
) -> Linearisation:
    """Return residuals, derivatives and weights; Huber's weight is min(1, huber / |r|)."""
    r = residuals(tracks, T_world_camera, landmarks)
    A = np.zeros((len(r), 3, 6))
    A[:, :, :3] = np.eye(3)
    R = T_world_camera[tracks.frame, :3, :3]
    A[:, :, 3:] = -se3.hat(np.einsum("kij,kj->ki", R, tracks.points))
    length = np.linalg.norm(r, axis=1)
    return Linearisation(huber / np.maximum(length, huber), A, r)


def cost(residual: Floats, huber: float) -> float:
    """Return the sum of Huber's losses of residuals (k, 3), m²."""
    length = np.linalg.norm(residual, axis=1)
    return float(np.where(length < huber, length**2 / 2, huber * (length - huber / 2)).sum())


def step(
    tracks: Tracks, lin: Linearisation, damping: float, moves: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """Solve the damped normal equations.

    Args:
        tracks: the observations.
        lin: linearised there.
        damping: times the diagonal, of poses and landmarks alike.
        moves: (N,) frames that do.

    Returns:
        Steps of poses (N, 6), [tau, phi], and of landmarks (L, 3), m.

    """
    n, w = tracks.frames, lin.weight
    wA = w[:, None, None] * lin.A
    own, g = np.zeros((n, 6, 6)), np.zeros((n, 6))
    np.add.at(own, tracks.frame, np.swapaxes(lin.A, 1, 2) @ wA)
    own[:, np.arange(6), np.arange(6)] *= 1 + damping
    W = (1 + damping) * np.bincount(tracks.track, w, minlength=len(tracks))
    pull = _sum_by_track(tracks, w[:, None] * lin.residual)
    # where the landmarks go if the poses stay
    left = lin.residual - (pull / W[:, None])[tracks.track]
    np.add.at(g, tracks.frame, np.einsum("kia,ki->ka", wA, left))

    blocks = np.zeros((n, 6, n, 6))
    blocks[np.arange(n), :, np.arange(n), :] = own
    S = blocks.reshape(6 * n, 6 * n)
    first = np.searchsorted(tracks.track, np.arange(len(tracks) + 1))
    _eliminate(first, tracks.frame, wA, 1 / W, S)
    free = np.repeat(moves, 6)
    delta = np.zeros((n, 6))
    delta[moves] = -np.linalg.solve(S[np.ix_(free, free)], g.ravel()[free]).reshape(-1, 6)

    pull += _sum_by_track(tracks, np.einsum("kia,ka->ki", wA, delta[tracks.frame]))
    return delta, pull / W[:, None]


def _sum_by_track(tracks: Tracks, rows: Floats) -> Floats:
    """Return (L, 3), the sums of rows (k, 3)."""
    return np.stack([np.bincount(tracks.track, x, minlength=len(tracks)) for x in rows.T], axis=1)


@nb.njit(cache=True, nogil=True)
def _eliminate(first, frame, wA, inverse, S):
    """Take ``(w_i A_i)ᵀ (w_j A_j) / W`` of every landmark's pairs of frames from S."""
    for track in range(first.shape[0] - 1):
        for k in range(first[track], first[track + 1]):
            a = 6 * frame[k]
            for m in range(first[track], first[track + 1]):
                b = 6 * frame[m]
                for i in range(6):
                    for j in range(6):
                        total = 0.0
                        for axis in range(3):
                            total += wA[k, axis, i] * wA[m, axis, j]
                        S[a + i, b + j] -= total * inverse[track]


def adjust(tracks: Tracks, T_start: Floats, options: LandmarkOptions) -> LandmarkSolution:
    """Find poses and landmarks of least cost; frame 0 stays, and so do frames without tracks.

    Args:
        tracks: the observations; what frames see must tie them together.
        T_start: (N, 4, 4).
        options: of the loss and the schedule.

    """
    moves = np.bincount(tracks.frame, minlength=tracks.frames) > 0
    moves[0] = False
    T = np.asarray(T_start)
    landmarks = _means(tracks, T)
    r = residuals(tracks, T, landmarks)
    now, damping, converged, done = cost(r, options.huber), options.damping, False, 0
    lin = linearise(tracks, T, landmarks, options.huber)
    while done < options.iterations and not converged and moves.any():
        done += 1
        try:
            delta, shift = step(tracks, lin, damping, moves)
        except np.linalg.LinAlgError:
            damping *= 10
            continue
        moved, shifted = se3.retract(T, delta), landmarks + shift
        after = cost(residuals(tracks, moved, shifted), options.huber)
        still = max(np.abs(delta).max(), np.abs(shift).max()) < STILL
        # a rise too small to tell from rounding is the end, too
        converged = bool(still or abs(now - after) <= options.tolerance * now)
        if after <= now:
            T, landmarks, now = moved, shifted, after
            damping = max(damping / 10, 1e-12)
            lin = linearise(tracks, T, landmarks, options.huber)
        else:
            damping *= 10
    return LandmarkSolution(T, landmarks, now, done, converged)


def _means(tracks: Tracks, T_world_camera: Floats) -> Floats:
    """Return where each landmark is seen on average (L, 3), m."""
    seen = residuals(tracks, T_world_camera, np.zeros((len(tracks), 3)))
    count = np.bincount(tracks.track, minlength=len(tracks))
    return _sum_by_track(tracks, seen) / count[:, None]
