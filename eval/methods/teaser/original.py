"""The authors' own program, where it is installed; there is no package of it to install."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from eval.methods.method import MethodError

if TYPE_CHECKING:
    from eval.methods.teaser.solver import TeaserOptions, TeaserResult

Floats = NDArray[np.float64]


def register_original(src: Floats, dst: Floats, options: TeaserOptions) -> TeaserResult:
    """Do what `solver.register` does; the masks follow from the motion, not from its weights."""
    import teaserpp_python as original

    from eval.methods.teaser.solver import LEAST, TeaserResult

    solver_class = original.RobustRegistrationSolver
    params = solver_class.Params()
    params.cbar2 = 1.0
    params.noise_bound = options.noise_bound
    params.estimate_scaling = False
    params.rotation_gnc_factor = options.gnc_factor
    params.rotation_max_iterations = options.most_iterations
    params.rotation_cost_threshold = options.least_change
    solver = solver_class(params)
    solver.solve(src.T, dst.T)
    clique = np.sort(np.asarray(solver.getInlierMaxClique(), dtype=np.int64))
    if len(clique) < LEAST:
        raise MethodError(f"{len(clique)} consistent matches, {LEAST} are needed")
    found = solver.getSolution()
    R, t = np.asarray(found.rotation), np.asarray(found.translation).reshape(3)
    offsets = dst[clique] - src[clique] @ R.T
    turned = np.linalg.norm(np.roll(offsets, -1, axis=0) - offsets, axis=1)
    return TeaserResult(
        T_target_source=se3.make(R, t),
        clique=clique,
        rotation_inliers=turned <= 2 * options.noise_bound,
        translation_inliers=(np.abs(offsets - t) <= options.noise_bound).all(axis=1),
        gnc_cost=float("nan"),
        iterations=0,
        edges=0,
        clique_proven=True,
    )
