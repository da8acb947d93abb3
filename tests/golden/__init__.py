"""Poses of a few small problems, kept for every version: what a change of the optimiser changes."""
