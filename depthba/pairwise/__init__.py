"""Start poses from pairs of frames, for measured poses too far off to start from."""

from depthba.pairwise.start import Pair, PairwiseStart, dataset_poses, pairwise_poses

__all__ = ["Pair", "PairwiseStart", "dataset_poses", "pairwise_poses"]
