"""Pairs of frames registered by features: found once, shared by the methods that build on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eval.methods.features import Keypoints
from eval.methods.method import Stopwatch, Task

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PairOptions:
    """How pairs of frames are registered by features."""

    voxel: float | None = None
    """Edge of the cubes that points are thinned to, m; None: by `features.usual_voxel`."""
    noise_bound: float = 0.75
    """Largest error of a matched point that counts as noise, in voxels."""
    most_matches: int = 2000
    """Matches that TEASER is given, the best by the ratio test."""


@dataclass(frozen=True, eq=False)
class FeaturePair:
    """How frame ``source`` lies on frame ``target``, by TEASER on FPFH matches."""

    target: int
    source: int
    T_target_source: Floats
    """(4, 4)."""
    matches: NDArray[np.int64]
    """(m, 2), keypoints of target and source that were matched: rows of `Keypoints.points`."""
    inliers: NDArray[np.int64]
    """(k,), rows of ``matches`` that agree: the maximum clique, cut to those within the bound."""
    seconds: Mapping[str, float]
    """That each stage took when the pair was made."""


def feature_pairs(
    task: Task,
    pairs: Sequence[tuple[int, int]],
    options: PairOptions,
    watch: Stopwatch,
) -> tuple[list[Keypoints], list[FeaturePair], list[tuple[int, int, str]]]:
    """Register pairs of frames by features, each once per dataset where the task has a cache.

    Args:
        task: the frames; their start poses are not used.
        pairs: frames (target, source), by index into ``task.clouds``.
        options: see there.
        watch: is charged with the stages "features", "matches" and "teaser"; with what they took
            when they were made, where the cache had them.

    Returns:
        The keypoints of all frames, the pairs that were registered, in the order asked, and those
        that were not, as (target, source, why).

    """
    raise NotImplementedError
