"""What changed between two maps, where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from depthba import se3
from depthba.change import height_change
from depthba.depth_map import DepthMap
from depthba.errors import OptionError, RunError

NOISE = 0.0005


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.05 * np.sin(3 * x) * np.cos(2 * y)


def heap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.04 * (np.hypot(x - 0.3, y + 0.2) < 0.15)


def mapped(
    low: float,
    high: float,
    spacing: float,
    seed: int,
    what: float = 0.0,
    T: np.ndarray | None = None,
) -> DepthMap:
    """The ground over a square of the map frame T_map_world, by Newton steps along its z axis."""
    T_map_world = np.eye(4) if T is None else T
    T_world_map = se3.inverse(T_map_world)
    n = round((high - low) / spacing) + 1
    x, y = np.meshgrid(low + spacing * np.arange(n), low + spacing * np.arange(n))
    z = np.zeros(x.shape)
    for _ in range(40):
        p = np.stack([x, y, z], axis=-1) @ T_world_map[:3, :3].T + T_world_map[:3, 3]
        wanted = ground(p[..., 0], p[..., 1]) + what * heap(p[..., 0], p[..., 1])
        z = z - (p[..., 2] - wanted) / T_world_map[2, 2]
    z = z + np.random.default_rng(seed).normal(0, NOISE, z.shape)
    ones = np.ones(z.shape)
    return DepthMap(z, (low, low), spacing, T_map_world, ones.astype(np.int64), NOISE * ones)


def test_a_heap_is_found_between_grids_that_differ() -> None:
    new, old = mapped(-1.0, 1.0, 0.01, 1, 1.0), mapped(-0.8, 1.2, 0.013, 2)
    found = height_change(new, old)
    assert found.region == pytest.approx((-0.8, 1.0, -0.8, 1.0), abs=0.011)
    assert found.area == pytest.approx(1.8**2, rel=0.02)
    truth = 0.04 * np.pi * 0.15**2
    assert found.volume(1) == pytest.approx(truth, rel=0.03)
    assert found.volume(-1) < 0.01 * truth
    assert found.sigma == pytest.approx(NOISE * np.sqrt(1 + 0.44), rel=0.15)
    back = height_change(old, new)
    assert back.volume(-1) == pytest.approx(truth, rel=0.03)


def test_maps_of_different_planes_agree_where_nothing_changed() -> None:
    T = se3.make(se3.exp_so3([0.1, -0.07, 0.6]), [0.1, 0.05, -0.3])
    found = height_change(mapped(-0.8, 0.8, 0.01, 1, T=T), mapped(-1.0, 1.0, 0.01, 2), as_is=True)
    assert np.nanmedian(np.abs(found.difference)) < 2 * NOISE
    assert np.nanquantile(np.abs(found.difference), 0.999) < 6 * NOISE
    assert found.offset == (0.0, 0.0, 0.0)


def test_what_both_differ_by_as_wholes_is_taken_off_and_stated() -> None:
    old, new = mapped(-1.0, 1.0, 0.01, 1), mapped(-1.0, 1.0, 0.01, 2, 1.0)
    x, y = np.meshgrid(*(-1 + 0.01 * np.arange(201),) * 2)
    lifted = DepthMap(
        new.heights + 0.007 + 0.004 * x - 0.002 * y, new.origin, 0.01, new.T_map_world, new.count,
        new.sigma,
    )  # fmt: skip
    found = height_change(lifted, old)
    assert found.offset == pytest.approx((0.007, 0.004, -0.002), abs=1e-4)
    assert found.volume(1) == pytest.approx(0.04 * np.pi * 0.15**2, rel=0.03)
    left_in = height_change(lifted, old, as_is=True)
    assert np.nanmedian(left_in.difference) == pytest.approx(0.007, abs=3e-4)


def test_maps_with_nothing_in_common_are_refused() -> None:
    near, far = mapped(0.0, 0.5, 0.01, 1), mapped(2.0, 2.5, 0.01, 1)
    with pytest.raises(RunError, match="0 nodes in common"):
        height_change(near, far)
    over = se3.make(se3.exp_so3([np.pi, 0, 0]), [0, 0, 0])
    turned = DepthMap(near.heights, near.origin, 0.01, over, near.count, near.sigma)
    with pytest.raises(RunError, match="z axes are 180° apart"):
        height_change(near, turned)
    with pytest.raises(OptionError, match="--least -1"):
        height_change(near, near, least=-1.0)
