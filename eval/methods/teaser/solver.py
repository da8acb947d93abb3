"""TEASER: from matches, most of them wrong, to a rigid motion.

Yang, Shi, Carlone, "TEASER: Fast and Certifiable Point Cloud Registration", T-RO 2020, without
scale: the maximum clique of consistent matches, then the rotation from differences of its points,
then the translation.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import Literal

import numba as nb
import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import se3
from eval.methods.method import MethodError
from eval.methods.teaser.choice import most_consistent
from eval.methods.teaser.clique import maximum_clique
from eval.methods.teaser.graph import consistency_graph, edge_count
from eval.methods.teaser.rotation import gnc_rotation
from eval.methods.teaser.translation import voted_translation

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEAST = 3
"""Matches that fix a rigid motion."""


@dataclass(frozen=True)
class TeaserOptions:
    """How to register matches."""

    noise_bound: float = 0.006
    """Largest error of a point that counts as noise, m."""
    gnc_factor: float = 1.4
    """By which the rotation's surrogate cost becomes less convex per iteration."""
    most_iterations: int = 100
    """Of the rotation."""
    least_change: float = 1e-12
    """Of the rotation's cost, m^2, under which it stops."""
    excluded: Literal["bound", "squared bound"] = "bound"
    """What the translation charges a match that does not agree. "squared bound" is the paper's
    truncated least squares. "bound", as the authors' program has it, is nearly a maximum consensus
    for bounds well under 1 m."""
    clique_seconds: float = 30.0
    """After which the largest clique so far must do."""
    backend: Literal["own", "auto"] = "own"
    """"auto": the authors' program where Python finds it as ``teaserpp_python``."""


@dataclass(frozen=True, eq=False)
class TeaserResult:
    """A rigid motion, and which matches speak for it."""

    T_target_source: Floats
    """(4, 4): ``dst = R src + t``."""
    clique: NDArray[np.int64]
    """(m,), matches that are all consistent, ascending."""
    rotation_inliers: Bools
    """(m,), of the differences ``clique[i] -> clique[i + 1]``, the last one back to the first."""
    translation_inliers: Bools
    """(m,), of the clique."""
    gnc_cost: float
    """Of the rotation, m^2; infinite where all differences agreed at once."""
    iterations: int
    """Of the rotation."""
    edges: int
    """Pairs of consistent matches; 0 where another backend does not tell."""
    clique_proven: bool
    """Whether no larger clique exists; False where time ran out."""

    @property
    def inliers(self) -> NDArray[np.int64]:
        """The matches (k,) of the clique that agree with the translation."""
        return self.clique[self.translation_inliers]


def register(src: ArrayLike, dst: ArrayLike, options: TeaserOptions | None = None) -> TeaserResult:
    """Return the motion that takes most of ``src`` (n, 3) to ``dst`` (n, 3), m.

    Raises:
        ValueError: the shapes differ or are not (n, 3), or a number is not finite.
        MethodError: fewer than three matches are consistent.

    """
    options = options or TeaserOptions()
    src, dst = (np.ascontiguousarray(p, dtype=np.float64) for p in (src, dst))
    if src.shape != dst.shape or src.ndim != 2 or src.shape[1] != 3:
        raise ValueError(f"matches of shapes {src.shape} and {dst.shape}, expected (n, 3) twice")
    if not (np.isfinite(src).all() and np.isfinite(dst).all()):
        raise ValueError("matches with NaN or infinity")
    if len(src) < LEAST:
        raise MethodError(f"{len(src)} matches, {LEAST} are needed")
    if options.backend == "auto" and importlib.util.find_spec("teaserpp_python"):
        from eval.methods.teaser.original import register_original

        return register_original(src, dst, options)
    graph = consistency_graph(src, dst, 2 * options.noise_bound)
    clique = maximum_clique(graph, options.clique_seconds)
    vertices = most_consistent(graph, src, dst, clique.vertices)
    return solve_clique(src, dst, vertices, options, edge_count(graph), clique.proven)


def solve_clique(
    src: Floats,
    dst: Floats,
    clique: NDArray[np.integer],
    options: TeaserOptions,
    edges: int = 0,
    clique_proven: bool = True,
) -> TeaserResult:
    """Return the motion by the matches ``clique`` (m,) of ``src`` and ``dst`` (n, 3), m.

    Raises `MethodError` for a clique of fewer than three.
    """
    if len(clique) < LEAST:
        raise MethodError(f"{len(clique)} consistent matches, {LEAST} are needed")
    bound = options.noise_bound
    R, t, rotation_inliers, translation_inliers, cost, iterations = _motion(
        src[clique],
        dst[clique],
        bound,
        bound if options.excluded == "bound" else bound**2,
        options.gnc_factor,
        options.most_iterations,
        options.least_change,
    )
    return TeaserResult(
        T_target_source=se3.make(R, t),
        clique=np.asarray(clique, dtype=np.int64),
        rotation_inliers=rotation_inliers,
        translation_inliers=translation_inliers,
        gnc_cost=float(cost),
        iterations=int(iterations),
        edges=edges,
        clique_proven=clique_proven,
    )


@nb.njit(cache=True, nogil=True)
def _motion(src, dst, bound, excluded, factor, most, least_change):
    """Return R, t, the two masks, the cost and the iterations for the points (m, 3) of a clique."""
    m = len(src)
    a, b = np.empty_like(src), np.empty_like(dst)
    for k in range(m):
        after = (k + 1) % m
        a[k], b[k] = src[after] - src[k], dst[after] - dst[k]
    # The noise of two points is in a difference.
    R, turned, cost, iterations = gnc_rotation(a, b, 2 * bound, factor, most, least_change)
    offsets = np.empty_like(src)
    for k in range(m):
        for i in range(3):
            offsets[k, i] = dst[k, i] - (
                R[i, 0] * src[k, 0] + R[i, 1] * src[k, 1] + R[i, 2] * src[k, 2]
            )
    t, agree = voted_translation(offsets, bound, excluded)
    return R, t, turned, agree, cost, iterations
