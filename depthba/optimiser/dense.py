"""Dense algebra on the unknowns of all frames, whose matrices no direction leaves open.

Many unknowns, those of hundreds of frames, take seconds: symmetry saves half of them, and whoever
cancels need not wait for the rest.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from depthba.optimiser.asking import look

Array = NDArray[np.float64]
T = TypeVar("T")

# Unknowns from which on a decomposition takes longer than anybody would wait.
MANY = 600
# Right-hand sides that are solved for between two looks.
COLUMNS = 128
# Between two looks, s.
PAUSE = 0.05


def patiently(work: Callable[[], T]) -> T:
    """Return what the work comes to; who cancels is answered at once, and the work left to itself.

    It must let other threads run, as NumPy's decompositions do.
    """
    done: queue.SimpleQueue[tuple[T | None, BaseException | None]] = queue.SimpleQueue()

    def run() -> None:
        try:
            done.put((work(), None))
        except BaseException as error:  # it is raised again where it was waited for
            done.put((None, error))

    threading.Thread(target=run, daemon=True).start()
    while True:
        look()
        try:
            value, error = done.get(timeout=PAUSE)
        except queue.Empty:
            continue
        if error is not None:
            raise error
        return value  # type: ignore[return-value]


def _timely(work: Callable[[], Any], unknowns: int) -> Any:
    return work() if unknowns <= MANY else patiently(work)


def cholesky(M: Array) -> Array:
    """Return the lower Cholesky factor of M (d, d); LinAlgError where a direction is open."""
    return np.asarray(_timely(lambda: np.linalg.cholesky(M), len(M)))


def solved(M: Array, B: Array) -> Array:
    """Return ``M^-1 B`` for a symmetric M (d, d) and B (d, n)."""
    try:
        L = cholesky(M)
    except np.linalg.LinAlgError:  # rounding has left it a little short of definite
        return np.asarray(_timely(lambda: np.linalg.solve(M, B), len(M)))
    return _by_columns(lambda b: cho_solve((L, True), b, check_finite=False), B)


def forward(L: Array, B: Array) -> Array:
    """Return ``L^-1 B`` for a lower factor L (d, d) and B (d, n)."""
    return _by_columns(lambda b: solve_triangular(L, b, lower=True, check_finite=False), B)


def inverse(M: Array) -> Array:
    """Return the inverse of M (d, d)."""
    return np.asarray(_timely(lambda: np.linalg.inv(M), len(M)))


def product(A: Array, B: Array) -> Array:
    """Return ``A B`` of matrices (d, d)."""
    return np.asarray(_timely(lambda: A @ B, len(A)))


def relative(part: Array, whole: Array) -> tuple[Array, Array]:
    """Return eigenvalues (d,) of a part in units of a definite whole, and vectors (d, d).

    Of the vectors v with values a, in columns, the part is ``V diag(a) V^T``, the whole ``V V^T``.
    """
    L = cholesky(whole)
    white = forward(L, forward(L, part).T)
    look()
    white += white.T
    values, vectors = _timely(lambda: np.linalg.eigh(white / 2), len(L))
    return values, product(L, vectors)


def _by_columns(solve: Callable[[Array], Array], B: Array) -> Array:
    d, n = B.shape
    if d <= MANY or n <= COLUMNS:
        return solve(B)
    out = np.empty((d, n))
    for k in range(0, n, COLUMNS):
        look()
        out[:, k : k + COLUMNS] = solve(B[:, k : k + COLUMNS])
    return out
