"""The real and synthetic datasets that lie beside the checkout, where they do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from depthba.dataset import Dataset, verify

DATA = Path(__file__).parents[3] / "shared" / "data"
NAMES = ["bumpy-a", "bumpy-b", "realsense-box", "rock-field", "ur5-tabletop-tray"]


@pytest.mark.parametrize("name", NAMES)
def test_opens_loads_and_verifies(name: str) -> None:
    if not (DATA / name).is_dir():
        pytest.skip(f"{DATA.name}/{name} is not beside this checkout")
    dataset = Dataset.open(DATA / name)
    assert dataset.name == name and dataset.warnings == () and len(dataset) > 10
    assert verify(DATA / name) == []
    camera, sensor = dataset.sensor.camera, dataset.sensor
    assert camera is not None and sensor.depth_min is not None and sensor.depth_max is not None
    points = dataset[0].points()
    assert len(points) > 10_000 and np.isfinite(points).all()
    assert sensor.depth_min <= points[:, 2].min() and points[:, 2].max() <= sensor.depth_max + 1e-6
    pixels = camera.project(points)
    np.testing.assert_allclose(pixels, np.rint(pixels), atol=1e-3)
    truth = dataset.T_world_camera_true
    if truth is not None:
        np.testing.assert_allclose(truth[0], dataset.T_world_camera_measured[0], atol=1e-9)
