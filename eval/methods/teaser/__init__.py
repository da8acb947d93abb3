"""TEASER, from its paper (Yang, Shi, Carlone, T-RO 2020)."""

from eval.methods.teaser.solver import TeaserOptions, TeaserResult, register, solve_clique

__all__ = ["TeaserOptions", "TeaserResult", "register", "solve_clique"]
