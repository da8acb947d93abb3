"""Every method of the registry, on three small frames of waves, from starts 3 mm, 3 mrad off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from depthba import se3
from depthba.dataset import Dataset
from depthba.errors import OptionError
from eval.benchmark.warming import small_dataset
from eval.methods import METHODS, Task, find_method, missing
from eval.metrics import pose_metrics

# Largest mean absolute error of the translations, m. Features are no finer than their voxels of
# four centimetres here; who lays surfaces onto each other must come well below the start's 2 mm.
FEATURES, SURFACES = 0.015, 0.0005
LIMITS = dict.fromkeys(METHODS, SURFACES) | {
    "initial": 0.003,
    "teaser": FEATURES,
    "teaser-pgo": FEATURES,
    "teaser-pgo-gnc": FEATURES,
    "teaser-ba": FEATURES,
    "kiss": FEATURES,
    "balm2": 0.0018,  # planes of one size on waves
}


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return small_dataset(tmp_path_factory.mktemp("small") / "waves")


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pairs")


@pytest.mark.parametrize("name", METHODS)
def test_it_registers(name: str, small: Dataset, cache: Path) -> None:
    if absent := missing(name):
        pytest.skip(f"needs {', '.join(absent)}")
    task = Task.of(small, cache=cache)
    start = task.T_world_camera.copy()
    found = find_method(name).run(task)
    T, T_true = found.T_world_camera, small.T_world_camera_true
    assert T_true is not None
    np.testing.assert_array_equal(task.T_world_camera, start)
    np.testing.assert_allclose(T[0], start[0], atol=1e-9)
    assert se3.is_rigid(T)
    errors = {m.name: m.value for m in pose_metrics(T, T_true)}
    assert errors["translation_mae"] < LIMITS[name]
    assert all(seconds >= 0 for seconds in found.seconds.values())
    assert bool(found.seconds) == (name != "initial")


def test_pairs_from_the_cache_are_charged(small: Dataset, tmp_path: Path) -> None:
    if absent := missing("teaser"):
        pytest.skip(f"needs {', '.join(absent)}")
    task = Task.of(small, cache=tmp_path)
    first, again = (find_method("teaser").run(task) for _ in range(2))
    np.testing.assert_array_equal(first.T_world_camera, again.T_world_camera)
    assert again.seconds.keys() == first.seconds.keys()
    assert again.seconds["features"] == pytest.approx(first.seconds["features"], rel=0.5)


@pytest.mark.parametrize("name", ["nope", "os:nothing", "no.such.module:Kind", "a b:Kind", ":"])
def test_a_method_that_is_not_there_is_named(name: str) -> None:
    with pytest.raises(OptionError, match=r"unknown; choose from|cannot be loaded"):
        find_method(name)
