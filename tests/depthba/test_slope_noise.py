"""Noise in the map's slope is not knowledge: what it puts into the reduced matrix is taken off."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import eigh

from depthba.optimiser import kernels, probes
from depthba.optimiser.feet import Feet
from depthba.optimiser.slope_noise import MANY, MARGIN, _less, firm, largest_share


def test_jacobians_of_slope_noise_against_plain_numpy() -> None:
    rng = np.random.default_rng(1)
    spacing, origin = 0.1, np.array([-1.0, -1.0])
    nodes, noise = np.zeros((21, 21, 3)), rng.normal(size=(21, 21, 3))
    points = np.ones((50, 3), np.float32)
    points[:, :2] = rng.uniform(-0.5, 0.5, (50, 2))
    inverse_noise = rng.uniform(0.5, 2.0, 50).astype(np.float32)
    share = rng.uniform(0.2, 1.0, 50).astype(np.float32)
    R, t = np.diag([1.0, -1.0, -1.0]), np.array([0.03, -0.02, 1.0])
    arm, weights = np.array([0.1, 0.2, 0.9]), rng.uniform(0.1, 1.0, 50).astype(np.float32)
    A, B = np.zeros((6, 6)), np.zeros((21, 21, 6))
    rows, cells = np.empty((kernels.ROWS, 50)), np.empty((2, 50), np.int32)
    kernels.feet(points, R, t, origin, spacing, nodes, False, False, 1.0, 0.2, rows, cells)
    feet = Feet(rows, cells)
    probes.slope_noise(
        inverse_noise, share, feet.on, cells, feet.fractions, feet.arms, feet.norm2, arm, weights,
        noise, A, B, 0, 0,
    )  # fmt: skip
    expected, coupled = np.zeros((6, 6)), np.zeros((21, 21, 6))
    each = share.astype(float) * weights * inverse_noise.astype(float) ** 2
    for p, w in zip(points.astype(float), each, strict=True):
        q = R @ p
        u, v = (q[:2] + t[:2] - origin) / spacing
        x, y = int(u), int(v)
        shares = {
            (y + dy, x + dx): (u - x if dx else 1 - u + x) * (v - y if dy else 1 - v + y)
            for dx in (0, 1)
            for dy in (0, 1)
        }
        gx, gy = sum(h * noise[node][1:] for node, h in shares.items())
        lever, slope = q + arm, np.array([-gx, -gy, 0.0])
        j = np.concatenate([slope, np.cross(lever, slope)])
        expected += w * np.outer(j, j)
        for node, h in shares.items():
            coupled[node] -= w * h * j
    np.testing.assert_allclose(A + np.tril(A, -1).T, expected, rtol=1e-5)
    np.testing.assert_allclose(B, coupled, rtol=1e-5, atol=1e-6)


def test_what_is_left_is_never_less_than_nothing() -> None:
    rng = np.random.default_rng(2)
    known, spurious = rng.normal(size=(3, 12)), rng.normal(size=(2, 12))
    S = known.T @ known * 100.0 + spurious.T @ spurious
    left = _less(S, MARGIN * spurious.T @ spurious, np.eye(12) * 0.1)
    assert np.linalg.eigvalsh(left).min() > -1e-6
    # Where there was noise alone, nothing; what was known stays.
    alone = np.linalg.qr(np.vstack([known, spurious]).T)[0][:, 3:]
    assert np.abs(alone.T @ left @ alone).max() < 1e-4
    clear = np.linalg.pinv(np.vstack([known, spurious]))[:, :3]
    np.testing.assert_allclose(clear.T @ left @ clear, 100.0 * np.eye(3), rtol=0.05, atol=2.0)


@pytest.mark.parametrize("d", [MANY - 1, MANY + 61])
def test_many_unknowns_are_judged_as_few_are(d: int) -> None:
    """By Lanczos' and by Cholesky's methods the same comes out as by all eigenvalues."""
    rng = np.random.default_rng(d)
    X, Y = rng.normal(size=(d, d)), rng.normal(size=(d, 40))
    whole, part = X @ X.T + 0.1 * d * np.eye(d), Y @ Y.T
    expected = eigh(part, whole, eigvals_only=True)[-1]
    assert_allclose(largest_share(part, whole), expected, rtol=1e-10)
    assert largest_share(0.0 * part, whole) == pytest.approx(0.0, abs=1e-12)
    assert np.array_equal(firm(whole), whole)
    # what nothing holds is still found, and held
    assert np.linalg.eigvalsh(part)[0] < 1e-9 < np.linalg.eigvalsh(firm(part))[0]
