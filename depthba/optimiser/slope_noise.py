"""What noise in the map's slope adds to the reduced matrix, and how to take it off again.

The pose Jacobian holds the map's gradient. The estimated map is noisy, so its gradient is never
zero: on a bare plane the normal equations claim to know a shift along it. The expectation of what
noise adds is found by drawing a map of nothing but noise, as the points would give it, and
eliminating it like the true one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, solve_triangular
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

from depthba.optimiser import dense, map_kernels, probes, reduced
from depthba.optimiser.asking import look
from depthba.optimiser.dense import MANY
from depthba.optimiser.feet import Ground
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import (
    Linearisation,
    Loss,
    State,
    footprint,
    robust_sigma,
)
from depthba.optimiser.map_solver import MapSolver
from depthba.optimiser.problem import Problem
from depthba.optimiser.workers import Workers

# Where noise adds less than this share in every direction, it is not worth the solves.
SLIGHT = 0.02
# What the data say counts as far as it exceeds this many times what noise alone would: what noise
# truly put in scatters about what a draw of it would have.
MARGIN = 2.0
# Tolerance of the solves: a draw of noise need not be eliminated exactly.
ROUGHLY = 0.1


def without_slope_noise(
    problem: Problem,
    grid: Grid,
    state: State,
    loss: Loss,
    lin: Linearisation,
    S: NDArray[np.float64],
    held: NDArray[np.float64],
    free: NDArray[np.bool_],
    workers: Workers,
    sigma: float | None = None,
    share: float = SLIGHT,
) -> tuple[NDArray[np.float64], float]:
    """Return the exact reduced matrix S (6N, 6N) less what noise in the map's slope put into it.

    And the largest share of noise in any direction, or a bound of it.

    Args:
        problem: the points.
        grid: where the nodes stand.
        state: the solution.
        loss: the residual.
        lin: its linearisation.
        S: (6N, 6N) exact reduced matrix.
        held: (6N, 6N) what the measured poses add to S: the share of the noise counts against both.
        free: (N,) frames that moved.
        workers: the threads.
        sigma: standard deviation of the points' noise, m; None: of their residuals.
        share: of noise in any direction, below which S itself is returned.
    """
    variance = (robust_sigma(lin.residuals) if sigma is None else sigma) ** 2
    noisy = noise_linearisation(problem, grid, state, loss, lin, workers)
    n = len(free)
    bound = np.zeros_like(S)
    for i in range(n):
        bound[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = variance * noisy.A[i]
    keep = np.ix_(np.repeat(free, 6), np.repeat(free, 6))
    if not free.any():
        return S, 0.0
    whole = firm((S + held)[keep])
    look()
    found = largest_share(bound[keep], whole)
    if found < share:
        return S, found
    noise = variance * reduced.exact(noisy, workers, ROUGHLY)
    found = largest_share(noise[keep], whole)
    if found < share:
        return S, found
    out = S.copy()
    out[keep] = _less(S[keep], MARGIN * noise[keep], held[keep])
    return out, found


def largest_share(part: NDArray[np.float64], whole: NDArray[np.float64]) -> float:
    """Return the largest share that a part has in any direction of a whole, both (d, d).

    That is the largest ``x^T part x / x^T whole x``; the part is no less than nothing in any
    direction, the whole is definite. Few unknowns: all such values are found (Golub & Van Loan
    2013, 8.7); many: the largest alone, by Lanczos' method, whose steps cost d^2 and not d^3.
    """
    d = len(part)
    if d <= MANY:
        return float(eigh(part, whole, eigvals_only=True)[-1])
    if not part.any():
        return 0.0
    root = dense.cholesky(whole)

    def times(v: NDArray[np.float64]) -> NDArray[np.float64]:
        look()
        inner = part @ solve_triangular(root, v.ravel(), trans="T", lower=True, check_finite=False)
        return np.asarray(solve_triangular(root, inner, lower=True, check_finite=False))

    # the same start every time
    start = np.random.default_rng(0).standard_normal(d)
    operator = LinearOperator((d, d), matvec=times, dtype=np.float64)
    try:
        return float(eigsh(operator, 1, which="LA", v0=start, return_eigenvectors=False)[0])
    except ArpackNoConvergence:
        return float(eigh(part, whole, eigvals_only=True)[-1])


def firm(whole: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix with what makes it positive definite: no direction may be held by nothing.

    The floor is relative to each unknown's own scale, and above what rounding leaves below zero.
    """
    # where next to nothing is known, rounding may have left less than nothing on the diagonal
    own = np.abs(np.diag(whole))
    own = np.maximum(own, 1e-12 * np.max(own, initial=1e-300))
    root = np.sqrt(own)  # of each: products of tiny ones would be nothing
    scaled = whole / root
    look()
    scaled /= root[:, None]
    if len(whole) > MANY and _definite(scaled):
        return whole
    values = np.linalg.eigvalsh(scaled)
    # rows that are next to nothing beside what couples them to others make for large values
    least = max(1e-9, 1e-12 * float(values[-1]))
    return np.asarray(whole + max(least - float(values[0]), 0.0) * np.diag(own))


def _definite(scaled: NDArray[np.float64]) -> bool:
    """Tell whether a matrix lies clear of the floor of `firm`, without any of its eigenvalues."""
    # no eigenvalue is larger (Gershgorin)
    largest = max(float(np.abs(row).sum()) for row in scaled)
    look()
    lower = scaled.copy()
    lower.flat[:: len(lower) + 1] -= 2.0 * max(1e-9, 1e-12 * largest)
    try:
        dense.cholesky(lower)
    except np.linalg.LinAlgError:
        return False
    return True


def _less(
    S: NDArray[np.float64], noise: NDArray[np.float64], held: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return ``S - noise`` with what would fall below nothing in units of ``S + held`` set to 0."""
    left = S - noise
    look()
    values, vectors = dense.relative(left, firm(S + held))
    below = values < 0.0
    left -= (vectors[:, below] * values[below]) @ vectors[:, below].T
    return left


def noise_linearisation(
    problem: Problem,
    grid: Grid,
    state: State,
    loss: Loss,
    lin: Linearisation,
    workers: Workers,
) -> Linearisation:
    """Normal equations whose Jacobians hold the gradient of a map drawn from unit noise alone."""
    ground = Ground(problem, grid, state, loss)
    rng = np.random.default_rng(0)
    count = len(problem.frames)
    total = np.zeros(grid.shape)
    for i, frame in enumerate(problem.frames):
        feet = ground.feet(i)
        probes.noise_gradient(
            frame.inverse_noise, frame.share, feet.on, feet.cells, feet.fractions, feet.norm2,
            lin.weights[i],
            rng.standard_normal(len(frame)), total,
        )  # fmt: skip
    heights, _ = MapSolver(lin.C, 1e-4).solve(-total, 1e-4)
    noise = np.empty((*grid.shape, 3))
    map_kernels.nodal_rows(heights, grid.spacing, noise, 0, len(heights))
    A = np.zeros((count, 6, 6))
    B = tuple(
        footprint(f, T, grid, loss, None)
        for f, T in zip(problem.frames, state.T_map_camera, strict=True)
    )

    def filled(i: int) -> None:
        feet, frame = ground.feet(i), problem.frames[i]
        B[i].values.fill(0.0)
        probes.slope_noise(
            frame.inverse_noise, frame.share, feet.on, feet.cells, feet.fractions, feet.arms,
            feet.norm2, state.T_map_camera[i, :3, 3] - lin.pivots[i], lin.weights[i], noise, A[i],
            B[i].values, B[i].x, B[i].y,
        )  # fmt: skip

    workers.map(filled, range(count))
    A += np.tril(A, -1).transpose(0, 2, 1)
    return replace(lin, A=A, B=B)
