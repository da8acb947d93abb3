"""The sets that the tests read, written once."""

from __future__ import annotations

import pytest

from depthba.dataset import Dataset
from tests.depthba.convert import small_scene


@pytest.fixture(scope="package")
def depth_set(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return small_scene.write_depth_set(tmp_path_factory.mktemp("depth") / "set")


@pytest.fixture(scope="package")
def cloud_set(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return small_scene.write_cloud_set(tmp_path_factory.mktemp("cloud") / "set")
