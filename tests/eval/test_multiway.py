"""Open3D's multiway registration: recovers poses it was disturbed from, and says what it left."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from depthba import se3
from eval.methods.method import MethodError
from eval.methods.multiway import Open3dMultiway
from eval.metrics import pose_metrics
from tests.eval.reference_scenes import made_task

pytest.importorskip("open3d")

Floats = NDArray[np.float64]

WAY = [(0.0, 0.0), (0.2, 0.0), (0.4, 0.0), (0.4, 0.2), (0.2, 0.2), (0.0, 0.2)]
"""Centres of the frames' views: there, and back beside it."""


def views() -> tuple[Floats, tuple[Floats, ...]]:
    """True poses, leaning a little, and what each frame sees of one surface, 1 mm noise."""
    rng = np.random.default_rng(0)
    T = se3.make(se3.exp_so3(rng.normal(size=(len(WAY), 3)) * 0.1), [[x, y, 1.0] for x, y in WAY])
    clouds = []
    for T_world_camera, centre in zip(T, WAY, strict=True):
        xy = rng.uniform(-0.25, 0.25, (12000, 2)) + centre
        x, y = xy.T
        z = 0.04 * np.sin(9 * x) * np.cos(11 * y) + 0.03 * np.sin(17 * y + 5 * x)
        p = np.column_stack([xy, z + 1e-3 * rng.normal(size=len(z))])
        clouds.append((p - T_world_camera[:3, 3]) @ T_world_camera[:3, :3])
    return T, tuple(clouds)


@pytest.mark.parametrize("estimation", ["plane", "generalised"])
def test_poses_are_recovered(estimation: Literal["plane", "generalised"]) -> None:
    T_true, clouds = views()
    off = np.random.default_rng(1).normal(size=(len(T_true), 6)) * ([0.005] * 3 + [0.01] * 3)
    off[0] = 0.0
    task = made_task(se3.retract(T_true, off), clouds, spacing=2.5e-3)
    found = Open3dMultiway(estimation=estimation).run(task)
    errors = {m.name: m.value for m in pose_metrics(found.T_world_camera, T_true)}
    assert errors["translation_mae"] < 5e-4 and errors["rotation_mae"] < 1e-3
    assert_allclose(found.T_world_camera[0], T_true[0], atol=1e-12)
    assert set(found.seconds) == {"pairs", "points", "icp", "graph"} and found.notes == ()


def test_what_overlaps_nothing_keeps_its_start() -> None:
    T_true, clouds = views()
    T = T_true.copy()
    T[5, 0, 3] += 9.0
    found = Open3dMultiway().run(made_task(T, clouds, spacing=2.5e-3))
    assert found.notes == ("not connected to frame 0, kept at their start poses: 5",)
    assert_allclose(found.T_world_camera[5], T[5])
    with pytest.raises(MethodError, match="no two frames overlap"):
        Open3dMultiway().run(made_task(T[[0, 5]], (clouds[0], clouds[5]), spacing=2.5e-3))
