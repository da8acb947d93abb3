"""Pairs of frames registered by features: found once, shared by the methods that build on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


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
