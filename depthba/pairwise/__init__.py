"""Start poses from pairs of frames, for measured poses too far off to start from."""

from depthba.pairwise.start import Pair, PairwiseStart, pairwise_poses

__all__ = ["Pair", "PairwiseStart", "pairwise_poses"]
