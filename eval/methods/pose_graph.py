"""Relative poses of all overlapping pairs, made consistent by a pose graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from eval.methods.features import REACH as BACKGROUND
from eval.methods.features import near_clouds
from eval.methods.gicp import Alignment, GicpOptions, Prepared, align, prepare
from eval.methods.graph import Edge, Solved, isotropic, solve, solve_robustly, spanning_tree
from eval.methods.method import Estimate, MethodError, Stopwatch, Task, relative
from eval.methods.overlap import LEAST, displacement, overlapping_pairs
from eval.methods.voxel import usual_voxel

if TYPE_CHECKING:
    from eval.methods.pairs import PairOptions

Floats = NDArray[np.float64]

REACH_SIGMAS = 3.0
"""The first partners are this many displacements by the start's error away, at most."""
STEADY = 1e-9
"""Information that every edge has in every direction, over its largest: keeps it invertible."""


@dataclass(frozen=True)
class GicpPgo:
    """Generalised ICP on all overlapping pairs from the start poses, then a pose graph.

    Round after round from the poses of the last, with ever nearer partners; each pair counts by
    the second derivative of its cost. What a user would reach for today.
    """

    voxel: float | None = None
    """Edge of the cubes that points are thinned to, m. None: `usual_voxel`."""
    reach: float | None = None
    """Partners in the first round are closer than this, m. None: `usual_reach`."""
    rounds: int = 4
    """At most; none follows the first whose reach was the least."""
    shrink: float = 3.0
    """By what the reach is divided from round to round."""
    least_reach: float = 1.2
    """In voxels: partners may always be so far away."""
    least_overlap: float = LEAST
    """See `overlapping_pairs`."""
    fewest: int = 100
    """A pair with fewer partners is left out."""
    background: float = BACKGROUND
    """How far points are used, in a frame's median ranges; see `features.near`."""
    gicp: GicpOptions = field(default_factory=GicpOptions)

    def run(self, task: Task) -> Estimate:
        """Register the frames from the start poses."""
        watch = Stopwatch()
        voxel = usual_voxel(task) if self.voxel is None else self.voxel
        reach = usual_reach(task) if self.reach is None else self.reach
        least = self.least_reach * voxel
        with watch("pairs"):
            pairs = overlapping_pairs(task, self.least_overlap)
        if not pairs:
            raise MethodError("no two frames overlap")
        with watch("points"):
            clouds = near_clouds(task, self.background)
            prepared = [prepare(p, voxel, self.gicp, task.threads) for p in clouds]
        T = task.T_world_camera
        for k in range(self.rounds):
            now = max(reach / self.shrink**k, least)
            with watch("gicp"):
                aligned = self._align(task, T, prepared, pairs, now, k)
            edges, failed = self._edges(pairs, aligned)
            if not edges:
                raise MethodError(f"none of {len(pairs)} overlapping pairs could be registered")
            with watch("graph"):
                solved = solve(T, edges)
            T = solved.T_world_camera
            if now <= least:
                break
        notes = [*failed, *_loose(solved)]
        return Estimate(T, watch.seconds, tuple(notes), iterations=solved.iterations)

    def _align(
        self,
        task: Task,
        T: Floats,
        prepared: Sequence[Prepared],
        pairs: Sequence[tuple[int, int]],
        reach: float,
        k: int,
    ) -> list[Alignment]:
        aligned = []
        for p, (i, j) in enumerate(pairs):
            task.say(f"round {k + 1}, pair {p + 1}/{len(pairs)}")
            T_i_j = relative(T, i, j)
            aligned.append(align(prepared[i], prepared[j], T_i_j, reach, self.gicp, task.threads))
        return aligned

    def _edges(
        self, pairs: Sequence[tuple[int, int]], aligned: Sequence[Alignment]
    ) -> tuple[list[Edge], list[str]]:
        """Return the pairs that were registered as edges, and a note on each of the others.

        One that spent its iterations is no failure: it creeps by less than matters.
        """
        edges, failed = [], []
        for (i, j), a in zip(pairs, aligned, strict=True):
            if not np.isfinite(a.T_target_source).all():
                failed.append(f"frames {i} and {j}: ICP left the numbers")
                continue
            if a.inliers < self.fewest:
                failed.append(f"frames {i} and {j}: {a.inliers} points have a partner")
                continue
            steady = STEADY * np.trace(a.H) * np.eye(6)
            edges.append(Edge(i, j, a.T_target_source, a.H + steady))
        return edges, failed


@dataclass(frozen=True)
class TeaserPgo:
    """TEASER on all overlapping pairs, then a pose graph in which all pairs count alike."""

    sigma_t: float = 0.01
    """Standard deviation of a relative pose, m per axis."""
    sigma_r: float = 0.01
    """The same for its rotation, rad."""
    robust: bool = False
    """Whether pairs may be rejected as outliers."""
    fewest: int = 8
    """A pair with fewer inliers is left out, unless nothing else ties its frames to frame 0: among
    2000 matches so few agree by chance, and in least squares one such pair is enough to ruin all
    poses."""
    least_overlap: float = LEAST
    """See `overlapping_pairs`."""
    pairs: PairOptions | None = None
    """How pairs are registered. None: as usual."""

    def run(self, task: Task) -> Estimate:
        """Register the frames; the start poses only say which overlap, and place frame 0."""
        from eval.methods.pairs import PairOptions, feature_pairs

        watch = Stopwatch()
        with watch("pairs"):
            wanted = overlapping_pairs(task, self.least_overlap)
        options = PairOptions() if self.pairs is None else self.pairs
        _, found, failed = feature_pairs(task, wanted, options, watch)
        if not found:
            raise MethodError(f"none of {len(wanted)} overlapping pairs could be registered")
        information = isotropic(self.sigma_t, self.sigma_r)
        edges = [Edge(p.target, p.source, p.T_target_source, information) for p in found]
        support = [len(p.inliers) for p in found]
        with watch("graph"):
            # The pair with the most inliers is the least likely to be wrong.
            T, tree = spanning_tree(task.T_world_camera, edges, support)
            chance = {k for k, s in enumerate(support) if s < self.fewest} - set(tree)
            edges = [e for k, e in enumerate(edges) if k not in chance]
            solved = solve_robustly(T, edges) if self.robust else solve(T, edges)
        notes = [f"frames {i} and {j}: {why}" for i, j, why in failed]
        for k in sorted(chance):
            i, j = found[k].target, found[k].source
            notes.append(f"frames {i} and {j}: {support[k]} matches agree, as few as by chance")
        if rejected := [f"{e.i}-{e.j}" for e, w in _weighed(edges, solved) if w < 0.5]:
            notes.append(f"pairs rejected as outliers: {', '.join(rejected)}")
        notes += _loose(solved)
        return Estimate(
            solved.T_world_camera, watch.seconds, tuple(notes), iterations=solved.iterations
        )


@dataclass(frozen=True)
class TeaserPgoGnc(TeaserPgo):
    """The same, robust by graduated non-convexity."""

    robust: bool = True


def usual_reach(task: Task) -> float:
    """Return how far the first partners may be, m: what the start's error makes likely."""
    return REACH_SIGMAS * displacement(task)


def _weighed(edges: Sequence[Edge], solved: Solved) -> list[tuple[Edge, float]]:
    """Return the edges that had a say, with the weights that they ended with."""
    return [
        (e, w) for e, w in zip(edges, solved.weights, strict=True) if e.i not in solved.loose
    ]  # fmt: skip


def _loose(solved: Solved) -> list[str]:
    if not solved.loose:
        return []
    frames = ", ".join(map(str, solved.loose))
    return [f"not connected to frame 0, kept at their start poses: {frames}"]
