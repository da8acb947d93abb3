"""Keypoints with FPFH descriptors, and the matches between two frames.

FPFH: Rusu, Blodow, Beetz, "Fast Point Feature Histograms for 3D registration", ICRA 2009, as Open3D
computes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Keypoints:
    """The thinned points of one frame, and what the surface around each looks like."""

    points: Floats
    """(n, 3), sensor frame, m."""
    descriptors: Floats
    """(n, 33), FPFH."""
