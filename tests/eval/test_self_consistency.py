"""How far frames agree, without truth."""

from __future__ import annotations

import numpy as np
import pytest

from depthba import se3
from eval.self_consistency import agreement

THICK, CELL = 0.004, 0.005


def seen_from(side: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a ramp and one face of a thin wall on it, seen from one side; and the pose."""
    rng = np.random.default_rng(1 if side > 0 else 0)
    ramp = rng.uniform((-0.15, -0.25, 0), (0.15, 0.25, 0), (60_000, 3))
    ramp[:, 2] = 0.5 * ramp[:, 0]
    wall = rng.uniform((0, -0.25, 0.1), (0, 0.25, 0.7), (90_000, 3))
    wall[:, 0] += side * THICK / 2
    sensor = np.array([side * 0.8, 0, 1.0])
    return np.concatenate([ramp, wall]) - sensor, se3.make(np.eye(3), sensor)


def test_faces_of_a_thin_wall_are_not_one_surface() -> None:
    (a, T_a), (b, T_b) = seen_from(-1.0), seen_from(1.0)
    pulled = T_b.copy()
    pulled[0, 3] -= THICK
    found = {}
    for name, T in (("true", T_b), ("pulled", pulled)):
        agreed = agreement([a, b], np.stack([T_a, T]), np.eye(3), CELL)
        found[name] = {m.name: m.value for m in agreed.metrics()}
    # to the nearest points the wall seems best without its thickness
    assert found["true"]["point_to_plane_median"] == pytest.approx(THICK, rel=0.1)
    assert found["pulled"]["point_to_plane_median"] < 0.25 * THICK
    # what lies on the same face says how far the frame was pulled across the ramp
    assert found["true"]["same_face_median"] < 1e-4
    across = THICK * 0.5 / np.hypot(1, 0.5)
    assert found["pulled"]["same_face_median"] == pytest.approx(across, rel=0.1)
