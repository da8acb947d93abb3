"""What is known about the solution, and what is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from depthba.optimiser import coupling, dense, patch_waves, pattern, probes, reduced
from depthba.optimiser.asking import look
from depthba.optimiser.feet import Ground
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import Linearisation, Loss, State, robust_sigma
from depthba.optimiser.patches import Patches
from depthba.optimiser.prior import PosePrior, about_pivot
from depthba.optimiser.problem import BLOCKS, Problem
from depthba.optimiser.slope_noise import firm, largest_share
from depthba.optimiser.workers import Workers
from depthba.result import WeakDirection

# A direction is weak when more than this share of what is known about it comes from the measured
# pose.
WEAK = 0.2


@dataclass(frozen=True)
class Correlation:
    """How much less the points know than as many independent ones would."""

    inflation: float
    """Factor on the variance of the poses, at least 1, where the data hold them least."""
    overall: float
    """The same over all directions alike."""
    S: NDArray[np.float64]
    """(6N, 6N), exact reduced matrix that it was measured with."""
    owed: float
    """Largest share that the measured poses have in any direction of the estimate, 0 to 1."""
    scores: NDArray[np.float64]
    """(blocks, 6N), reduced gradient of each block of the image, about their mean."""


def correlation(
    problem: Problem,
    grid: Grid,
    state: State,
    loss: Loss,
    lin: Linearisation,
    prior: PosePrior,
    free: NDArray[np.bool_],
    workers: Workers,
    reduction: reduced.Reduction | None = None,
    believed: pattern.Believed | None = None,
    patches: Patches | None = None,
) -> Correlation:
    """Measure how the residuals' correlation over the image inflates the variance of the poses.

    Gradients are summed over blocks of the image, over all frames at once, since a fixed pattern is
    common to them (cluster-robust variance, Liang & Zeger 1986). The same sums over as many random
    groups of points say what independent residuals would give. Each gives a scatter of the
    estimate, ``V G V`` with ``V = (S + T P)^-1``; the factor is the ratio of the two in units of
    the prior P, so that the directions count that the data hold least. The prior's weight T depends
    on the factor in turn, which a few rounds settle. In units of what the data say, S, all
    directions count alike: the second factor.

    A fixed pattern that was ``believed`` in and solved for is eliminated as the map is. It leaves
    little that all frames have in common, so blocks count that are dealt out anew for each frame,
    too, and whichever of the two says more. ``patches``, fitted at the state, say what they say
    beside the map; the reduction holds it.
    """
    reduction = reduction or reduced.reduce(lin, workers)
    S = reduction.S if believed is None else believed.eliminated(reduction.S)
    keep = np.repeat(free, 6)
    if not keep.any():
        return Correlation(1.0, 1.0, S, 0.0, np.zeros((1, len(S))))
    inner = firm(S[np.ix_(keep, keep)])
    P = prior.at(state.T_map_camera).normal_equations(lin.pivots)[0][np.ix_(keep, keep)]
    count = BLOCKS[0] * BLOCKS[1]
    rng = np.random.default_rng(0)
    random = tuple(rng.integers(0, count, len(f)).astype(np.uint8) for f in problem.frames)
    blocks = tuple(f.blocks for f in problem.frames)
    kinds = [blocks, random]
    if believed is not None:
        kinds.append(tuple(rng.permutation(count).astype(np.uint8)[b] for b in blocks))
    groups = [np.stack(g) for g in zip(*kinds, strict=True)]
    scores = block_scores(problem, grid, state, loss, lin, groups, workers, reduction)
    if believed is not None and problem.waves is not None:
        own = pattern.scores(
            Ground(problem, grid, state, loss), lin, problem.waves, believed.found, groups, count,
            workers,
        )  # fmt: skip
        if patches is not None and believed.found.surfaces is not None:
            own = own + patch_waves.scores(
                patches, state.T_map_camera, problem.waves, believed.found.surfaces, groups, count,
                workers,
            )  # fmt: skip
        scores = scores + believed.follow(own)
    if patches is not None:
        scores = scores + patches.scores(state.T_map_camera, lin.pivots, groups, count, workers)
    scores = scores[..., keep]
    scores = scores - scores.mean(axis=1, keepdims=True)
    variance = max(robust_sigma(lin.residuals), problem.rounding) ** 2
    factor = 1.0
    for _ in range(10):
        look()
        moved = _solved(inner + max(factor * variance, 1e-30) * P, list(scores))
        spread = [_form(x, P) for x in moved]
        before = factor
        factor = max(1.0, max(spread[0], spread[-1]) / max(spread[1], 1e-300))
        if factor == before:
            break
    mixed = [_neighbours_mixed(scores[0]), *scores[1:]]
    moved = _solved(inner + max(variance, 1e-30) * P, mixed)
    alike = [float(np.vdot(s, x)) for s, x in zip(mixed, moved, strict=True)]
    overall = max(1.0, max(alike[0], alike[-1]) / max(alike[1], 1e-300))
    T = max(factor * variance, 1e-30)
    owed = largest_share(T * P, inner + T * P)
    whole = np.zeros((count, len(S)))
    whole[:, keep] = scores[0]
    return Correlation(factor, overall, S, owed, whole)


def _solved(
    whole: NDArray[np.float64], scores: Sequence[NDArray[np.float64]]
) -> list[NDArray[np.float64]]:
    """Return ``whole^-1 s`` for each kind of scores s, (blocks, d)."""
    found = dense.solved(whole, np.concatenate(scores).T).T
    return np.split(found, len(scores))


def _form(x: NDArray[np.float64], M: NDArray[np.float64]) -> float:
    """Return the sum of ``x_b^T M x_b`` over blocks b; x (blocks, d)."""
    return float(np.vdot(x @ M, x))


def _neighbours_mixed(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return scores (blocks, d) whose plain scatter is the given ones' with neighbours' products.

    Products of blocks next to each other count by half, along both axes of the image (Bartlett's
    kernel, which keeps the scatter positive).
    """
    columns, rows = (np.eye(n) + 0.5 * (np.eye(n, k=1) + np.eye(n, k=-1)) for n in BLOCKS)
    return np.asarray(np.linalg.cholesky(np.kron(rows, columns)).T @ scores)


def beyond_scalar(
    scores: NDArray[np.float64], S: NDArray[np.float64], variance: float
) -> NDArray[np.float64]:
    """Return F (d, k): blocks' gradients scatter by ``F F^T`` beyond ``variance * S``.

    One factor on the variance is too little for the directions in which the blocks' gradients add
    up, such as a pattern that tilts all frames alike. Of as many blocks of independent points the
    largest scatter relative to what is expected would be about ``(1 + sqrt(d / blocks))^2``
    (Marchenko & Pastur 1967); directions above that count with what they show.

    Args:
        scores: (blocks, d), about their mean.
        S: (d, d) reduced matrix.
        variance: m^2, of a residual, with its inflation.
    """
    blocks, d = scores.shape
    expected = variance * S
    expected = expected + np.diag(1e-6 * np.diag(expected) + 1e-300)
    root = dense.cholesky(firm(expected))
    white = dense.forward(root, scores.T)
    vectors, sizes, _ = np.linalg.svd(white, full_matrices=False)
    above = sizes > 1 + np.sqrt(d / blocks)
    return np.asarray(root @ (vectors[:, above] * np.sqrt(sizes[above] ** 2 - 1)))


def block_scores(
    problem: Problem,
    grid: Grid,
    state: State,
    loss: Loss,
    lin: Linearisation,
    groups: list[NDArray[np.uint8]],
    workers: Workers,
    reduction: reduced.Reduction,
) -> NDArray[np.float64]:
    """Return the reduced gradient of each group of points, (kinds, groups, 6N).

    The map has answered to it. ``groups`` says for each frame, (kinds, n), which group a point is
    in, for one or several ways to group them.
    """
    ground = Ground(problem, grid, state, loss)
    shape = len(groups[0]), BLOCKS[0] * BLOCKS[1], 6
    answers = reduction.answers

    def of(frames: range) -> NDArray[np.float64]:
        scores = np.zeros((len(problem.frames), *shape))
        for i in frames:
            frame, T, foot = problem.frames[i], state.T_map_camera[i], lin.B[i]
            feet, pulls = ground.feet(i), np.empty(len(frame))
            probes.contributions(
                frame.inverse_noise, frame.share, feet.on, feet.arms, feet.slopes, feet.norm2,
                feet.residuals, T[:3, 3] - lin.pivots[i], lin.weights[i], groups[i], pulls,
                scores[i],
            )  # fmt: skip
            for other, answer in enumerate(answers):
                if coupling.meet(foot, answer):
                    probes.answered(
                        feet.cells, feet.fractions, pulls, groups[i], answer.values, answer.x,
                        answer.y, scores[other],
                    )  # fmt: skip
        return scores

    total = sum(workers.map(of, workers.shares(problem)), start=np.zeros((1, 1, 1, 1)))
    return np.asarray(np.moveaxis(total, 0, 2).reshape(*shape[:2], -1))


@dataclass(frozen=True)
class Certainty:
    """Covariance of the poses and the directions that the data leave open."""

    covariance: NDArray[np.float64]
    """(6N, 6N), translation then rotation, world axes, about the camera centre."""
    weak: tuple[WeakDirection, ...]


def assess(
    problem: Problem,
    state: State,
    lin: Linearisation,
    S: NDArray[np.float64],
    variance: float,
    prior: PosePrior,
    believed: bool,
    free: NDArray[np.bool_],
    frame_ids: tuple[int, ...],
    known: Correlation | None = None,
    doubt: float = 1.0,
) -> Certainty:
    """Turn the exact reduced matrix into covariances and a verdict on observability.

    Args:
        problem: the points.
        state: the solution.
        lin: its linearisation.
        S: (6N, 6N) exact reduced matrix.
        variance: m^2, of a residual, times its inflation.
        prior: the measured poses; without belief in them they still judge which directions are
            weak.
        believed: whether the prior took part in the solution.
        free: (N,) frames that moved.
        frame_ids: ids of the frames.
        known: how the residuals are correlated: what the blocks' gradients scatter beyond the
            variance adds to the covariance.
        doubt: factor on the variance by which the verdict alone is more careful.
    """
    n = len(free)
    keep = np.repeat(free, 6)
    J = about_pivot(state.T_map_camera, lin.pivots)
    data = S[np.ix_(keep, keep)] / max(variance, 1e-30)
    held = prior.at(state.T_map_camera).normal_equations(lin.pivots)[0][np.ix_(keep, keep)]
    posterior = dense.inverse(data + held)
    careful = posterior if doubt == 1.0 else dense.inverse(data / doubt + held)
    if known is not None and keep.any():
        whole = known.S[np.ix_(keep, keep)]
        scatter = beyond_scalar(known.scores[:, keep], whole, variance) / max(variance, 1e-30)
        moved = posterior @ scatter
        look()
        beyond = moved @ moved.T
        posterior, careful = posterior + beyond, careful + beyond
    weak = _weak_directions(careful, held, free, frame_ids, problem)
    about_pivots = np.zeros((6 * n, 6 * n))
    # without belief in the prior a trace of it stays, so that open directions are large and not
    # infinite
    about_pivots[np.ix_(keep, keep)] = posterior if believed else dense.inverse(data + 1e-6 * held)
    for i in np.flatnonzero(~free):
        if prior.information[i].any():
            inverse = np.linalg.inv(J[i])
            about_pivots[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = (
                inverse @ np.linalg.inv(prior.information[i]) @ inverse.T
            )
    turn = np.kron(np.eye(2), problem.T_map_world[:3, :3].T)
    covariance = _both_sides(about_pivots, turn @ J)
    return Certainty((covariance + covariance.T) / 2, weak)


def _both_sides(M: NDArray[np.float64], J: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``J M J^T`` for block-diagonal J given as (N, 6, 6)."""
    n = len(J)
    rows = np.einsum("iab,ibjc->iajc", J, M.reshape(n, 6, n, 6))
    return np.asarray(np.einsum("iajc,jdc->iajd", rows, J).reshape(6 * n, 6 * n))


def _weak_directions(
    posterior: NDArray[np.float64],
    held: NDArray[np.float64],
    free: NDArray[np.bool_],
    frame_ids: tuple[int, ...],
    problem: Problem,
) -> tuple[WeakDirection, ...]:
    """Find where a frame's posterior owes more to its measured pose than to the data.

    In units of the prior a posterior variance lies between 0 (the data say all) and 1 (they say
    nothing). Directions are taken about the frame's own centroid, where shift and turn are least
    alike.
    """
    weak = []
    measured = dense.inverse(held)
    for k, i in enumerate(np.flatnonzero(free)):
        window = slice(6 * k, 6 * k + 6)
        believed = measured[window, window]
        values, duals = eigh(posterior[window, window], believed)
        lever = problem.frames[i].extent
        for value, dual in zip(values[::-1], duals.T[::-1], strict=True):
            if value <= WEAK:
                break
            one_sigma = believed @ dual * np.repeat([1.0, max(lever, 1e-9)], 3)
            prior_sigma = float(np.linalg.norm(one_sigma))
            share = min(float(value), 1 - 1e-9)
            direction = one_sigma / prior_sigma
            weak.append(
                WeakDirection(
                    frame=frame_ids[i],
                    name=direction_name(direction),
                    direction=direction,
                    lever=lever,
                    sigma=prior_sigma * float(np.sqrt(share / (1 - share))),
                    prior_sigma=prior_sigma,
                )
            )
    return tuple(weak)


def direction_name(direction: NDArray[np.float64]) -> str:
    """Name a unit direction (6,) for people, by its main parts.

    ``x``, ``turn about z``, ``0.8 x + 0.6 y``.
    """
    names = ("x", "y", "z", "turn about x", "turn about y", "turn about z")
    direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
    order = [int(k) for k in np.argsort(-np.abs(direction)) if abs(direction[k]) > 0.3]
    if len(order) == 1:
        return names[order[0]]
    parts = [f"{abs(direction[k]):.1f} {names[k]}" for k in order]
    signs = ["-" if direction[k] < 0 else "+" for k in order]
    return parts[0] + "".join(f" {s} {p}" for s, p in zip(signs[1:], parts[1:], strict=True))
