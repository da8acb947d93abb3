"""Methods that register consecutive frames and chain them."""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from eval.methods.features import REACH, near_clouds, usual_voxel
from eval.methods.method import Estimate, MethodError, Stopwatch, Task, chained, relative
from eval.methods.pairs import PairOptions, feature_pairs, pair_voxel

Floats = NDArray[np.float64]

LEAST_POINTS = 10
"""Of a frame, for GICP and KISS-Matcher."""


@dataclass(frozen=True)
class Teaser:
    """TEASER on FPFH matches of consecutive frames, chained from the first frame's start pose."""

    pairs: PairOptions = field(default_factory=PairOptions)

    def run(self, task: Task) -> Estimate:
        """Register the frames; a pair that fails keeps how the start has it."""
        watch = Stopwatch()
        steps, notes = _teaser_steps(task, self.pairs, watch)
        return _estimate(task, steps, watch, notes)


@dataclass(frozen=True)
class TeaserIcp:
    """`Teaser`, then small_gicp's GICP on each pair of consecutive frames."""

    pairs: PairOptions = field(default_factory=PairOptions)
    downsample: float = 0.5
    """Edge of the cubes that points are averaged in, in voxels."""
    max_distance: float = 3.0
    """Between points that count as the same, in voxels."""
    max_iterations: int = 50

    def run(self, task: Task) -> Estimate:
        """Register the frames; a pair that TEASER fails on keeps how the start has it."""
        import small_gicp

        watch = Stopwatch()
        voxel = pair_voxel(task, self.pairs, watch)
        steps, notes = _teaser_steps(task, self.pairs, watch)
        refined = dict(steps)
        with watch("icp"):
            clouds = near_clouds(task, self.pairs.reach)
            ready: dict[int, tuple] = {}
            for k, T_start in steps.items():
                task.say(f"GICP, pair {k + 1}/{len(task) - 1}")
                for i in (k, k + 1):
                    if i not in ready:
                        ready[i] = small_gicp.preprocess_points(
                            clouds[i],
                            downsampling_resolution=self.downsample * voxel,
                            num_threads=task.threads,
                        )
                (target, tree), (source, _) = ready[k], ready[k + 1]
                found = small_gicp.align(
                    target,
                    source,
                    tree,
                    T_start,
                    registration_type="GICP",
                    max_correspondence_distance=self.max_distance * voxel,
                    max_iterations=self.max_iterations,
                    num_threads=task.threads,
                )
                if se3.is_rigid(found.T_target_source):
                    refined[k] = found.T_target_source
                else:
                    notes.append(f"frames {k} and {k + 1}: GICP diverged, TEASER's pose is kept")
                ready.pop(k)
        return _estimate(task, refined, watch, notes)


@dataclass(frozen=True)
class Kiss:
    """KISS-Matcher on consecutive frames, chained from the first frame's start pose.

    Lim et al., "KISS-Matcher: Fast and Robust Point Cloud Registration Revisited", ICRA 2025, by
    its authors' package, whose own radii and bounds are multiples of the voxel. Its answer repeats
    with one thread only.
    """

    voxel: float | None = None
    """Edge of the cubes that points are thinned to, m; None: by `features.usual_voxel`."""
    reach: float = REACH
    """How far points are used, in a frame's median ranges; see `features.near`."""
    least_inliers: int = 5
    """Matches that agree; a pair with fewer failed."""

    def run(self, task: Task) -> Estimate:
        """Register the frames; a pair that fails keeps how the start has it."""
        package = _loaded_kiss(task.threads)
        watch = Stopwatch()
        steps, notes = {}, []
        with watch("register"):
            clouds = near_clouds(task, self.reach)
            voxel = self.voxel or usual_voxel(clouds, task.spacing)
            for k, (target, source) in enumerate(pairwise(clouds)):
                task.say(f"KISS-Matcher, pair {k + 1}/{len(task) - 1}")
                if min(len(target), len(source)) < LEAST_POINTS:
                    notes.append(_failed(k, k + 1, "too few points"))
                    continue
                # A new one each time: what it keeps of the last pair must not matter.
                matcher = package.KISSMatcher(package.KISSMatcherConfig(voxel))
                matched = matcher.match(np.asfortranarray(source.T), np.asfortranarray(target.T))
                if len(matched[0]) < self.least_inliers:
                    notes.append(_failed(k, k + 1, f"{len(matched[0])} matches"))
                    continue
                found = matcher.prune_and_solve(*matched)
                T = se3.make(np.asarray(found.rotation), np.asarray(found.translation).reshape(3))
                inliers = matcher.get_num_final_inliers()
                if not found.valid or inliers < self.least_inliers or not se3.is_rigid(T, 1e-3):
                    notes.append(_failed(k, k + 1, f"{inliers} matches agree"))
                else:
                    steps[k] = T
        return _estimate(task, steps, watch, notes)


@cache
def _loaded_kiss(threads: int) -> ModuleType:
    """Return the package, told how many threads to use.

    Its threads share out work by chance, and its answer depends on that by millimetres. It has no
    setting for their number, but asks once how many cores this thread may use: when it first works.
    """
    every = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    if every:
        os.sched_setaffinity(0, sorted(every)[:threads])
    try:
        package = importlib.import_module("kiss_matcher")
        points = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 2000))
        package.KISSMatcher(package.KISSMatcherConfig(0.1)).match(points, points)
    finally:
        if every:
            os.sched_setaffinity(0, every)
    return package


def _teaser_steps(
    task: Task, options: PairOptions, watch: Stopwatch
) -> tuple[dict[int, Floats], list[str]]:
    """Return T_k_k+1 by k where TEASER found one, and what is to be said."""
    asked = [(k, k + 1) for k in range(len(task) - 1)]
    _, found, failed = feature_pairs(task, asked, options, watch)
    notes = [_failed(*why) for why in failed] + [pair.note for pair in found if pair.note]
    return {pair.target: pair.T_target_source for pair in found}, notes


def _failed(target: int, source: int, why: str) -> str:
    return f"frames {target} and {source}: {why}; the start's relative pose is kept"


def _estimate(
    task: Task, steps: Mapping[int, Floats], watch: Stopwatch, notes: Sequence[str]
) -> Estimate:
    """Chain what was found, T_k_k+1 by k; the start's relative poses fill the gaps."""
    count = len(task) - 1
    if count > 0 and not steps:
        raise MethodError(f"all {count} pairs of consecutive frames failed; {notes[0]}")
    start = task.T_world_camera
    every = [steps.get(k, relative(start, k, k + 1)) for k in range(count)]
    return Estimate(chained(start[0], every), watch.seconds, tuple(notes))
