"""Equations that double precision cannot solve, said in the user's terms."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np

from depthba.errors import Unsolvable
from depthba.optimiser.problem import Problem


@contextlib.contextmanager
def solvable(problem: Problem, name: str) -> Iterator[None]:
    """Turn what linear algebra gives up on into a known error that says how large the scene is.

    Args:
        problem: what is solved.
        name: of the dataset, for the message.

    Raises:
        Unsolvable: a matrix is singular, or its eigenvalues do not converge.
    """
    try:
        yield
    except np.linalg.LinAlgError as error:
        across = float((problem.upper - problem.lower).max())
        raise Unsolvable(
            f"{name}: the equations cannot be solved ({str(error).rstrip('.')}): the scene is "
            f"{across:.3g} m across, seen from {problem.ranges:.3g} m, with points "
            f"{problem.spacing:.3g} m apart; expected lengths that fit each other: check fx, fy, "
            "depth_scale and the unit of the poses"
        ) from error
