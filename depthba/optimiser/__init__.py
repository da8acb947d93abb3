"""The optimiser: all poses and one depth map from one sparse non-linear least-squares problem."""
