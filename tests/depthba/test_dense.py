"""Dense algebra: few and many unknowns alike, and who cancels need not wait."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from numpy.testing import assert_allclose

from depthba.errors import Cancelled
from depthba.optimiser import dense
from depthba.optimiser.asking import listening


def definite(d: int, rng: np.random.Generator) -> np.ndarray:
    X = rng.normal(size=(d, d))
    return X @ X.T + 0.1 * d * np.eye(d)


@pytest.mark.parametrize("d", [30, dense.MANY + 20])
def test_few_and_many_unknowns_are_solved_alike(d: int) -> None:
    rng = np.random.default_rng(d)
    M, B = definite(d, rng), rng.normal(size=(d, dense.COLUMNS + 3))
    L = dense.cholesky(M)
    assert_allclose(L @ L.T, M, atol=1e-9 * d)
    assert_allclose(M @ dense.solved(M, B), B, atol=1e-9)
    assert_allclose(L @ dense.forward(L, B), B, atol=1e-9)
    assert_allclose(dense.inverse(M) @ M, np.eye(d), atol=1e-9)
    part = B[:, :40] @ B[:, :40].T - B[:, 40:80] @ B[:, 40:80].T
    values, V = dense.relative(part, M)
    assert_allclose((V * values) @ V.T, part, atol=1e-8 * d)
    assert_allclose(V @ V.T, M, atol=1e-8 * d)
    with pytest.raises(np.linalg.LinAlgError):
        dense.cholesky(-M)


def test_a_matrix_a_little_short_of_definite_is_solved_all_the_same() -> None:
    M = np.diag([1.0, 2.0, -1e-9])
    assert_allclose(dense.solved(M, np.eye(3)) @ M, np.eye(3), atol=1e-9)


def test_who_cancels_need_not_wait_for_a_decomposition() -> None:
    stop, began, end = threading.Event(), threading.Event(), threading.Event()

    def work() -> None:
        began.set()
        end.wait(20.0)

    def cancel() -> None:
        began.wait(20.0)
        stop.set()

    threading.Thread(target=cancel).start()
    with listening(stop.is_set), pytest.raises(Cancelled):
        dense.patiently(work)
    assert not end.is_set()
    end.set()


def test_what_goes_wrong_apart_is_raised_where_it_was_waited_for() -> None:
    def fails() -> None:
        time.sleep(0.01)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        dense.patiently(fails)
