"""Overlapping pairs: near the reference's at the truth, and still there at a poor start."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from eval.methods.overlap import overlap, overlapping_pairs
from tests.eval.reference_scenes import made_task, reference_task


@pytest.mark.parametrize("name", ["s0", "s1"])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_pairs_of_the_reference_scenes(name: str, noise: float) -> None:
    """The reference counts points where the map has cells: shares differ by up to 0.08."""
    task, _, shares = reference_task(name, 0.01 * noise, 0.02 * noise)
    found = set(overlapping_pairs(task))
    clear = {(int(i), int(j)) for i, j in np.argwhere(shares > 0.3)}
    possible = {(int(i), int(j)) for i, j in np.argwhere(shares > 0.17)}
    assert clear <= found <= possible
    assert {(k, k + 1) for k in range(11)} <= found
    assert abs(len(found) - np.count_nonzero(shares > 0.25)) <= 3


def square(x: float, z: float, side: int = 100) -> np.ndarray:
    """Points 1 mm apart on a level square of 0.1 m that begins at x."""
    u, v = np.meshgrid(np.arange(side), np.arange(side))
    return np.stack([x + 1e-3 * u, 1e-3 * v, np.full(u.shape, z)], axis=-1).reshape(-1, 3)


def test_shares_are_of_the_smaller_frame() -> None:
    whole, half, none = square(0.0, 0.0), square(0.06, 0.0), np.empty((0, 3))
    task = made_task(np.tile(np.eye(4), (4, 1, 1)), (whole, half, whole[:2000], none), spacing=1e-3)
    shares = overlap(task)
    assert_allclose(shares, shares.T)
    assert_allclose(np.diag(shares), [1.0, 1.0, 1.0, 0.0])
    assert_allclose(shares[0, 1], 0.4, atol=0.02)
    assert_allclose(shares[0, 2], 1.0)
    assert overlapping_pairs(task) == [(0, 1), (0, 2), (1, 2)]
    assert overlapping_pairs(task, least=0.5) == [(0, 2)]


def test_what_lies_far_above_is_no_overlap() -> None:
    """Upper and lower side of a thing half a metre thick."""
    task = made_task(
        np.tile(np.eye(4), (3, 1, 1)),
        (square(0.0, 0.0), square(0.0, 0.5), square(0.0, 0.02)),
        spacing=1e-3,
    )
    assert overlapping_pairs(task) == [(0, 2)]
