from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import sim
from sim.engine import mujoco
from sim.scenes import SCENES, Scene
from sim.seeds import stream

SMALL = (320, 240)


@pytest.fixture(scope="session")
def clean_bay(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """industrial-6 without any noise."""
    options = sim.GenerateOptions(seed=3, size=SMALL, clean=True, rgb=False)
    return sim.generate("industrial-6", tmp_path_factory.mktemp("clean") / "bay", options)


@pytest.fixture(scope="session")
def noisy_bay(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same bay as its sensor and its gantry report it."""
    options = sim.GenerateOptions(seed=3, size=SMALL, rgb=False)
    return sim.generate("industrial-6", tmp_path_factory.mktemp("noisy") / "bay", options)


def heap(seed: int) -> mujoco.MjSpec:
    """A few boxes on a plane and one marker: a scene that is built in no time."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9, 9, 0.1])
    rng = stream(seed, "heap")
    for _ in range(12):
        size, place = rng.uniform(0.05, 0.3, 3), rng.uniform(-1.0, 3.0, 2)
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=size,
            pos=[*place, size[2]],
            rgba=[0.4, 0.3, 0.2, 1],
        )
    spec.worldbody.add_geom(
        name="marker_only",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[0.1, 0.002, 0],
        pos=[0.2, 1.0, 0.7],
    )
    return spec


@pytest.fixture
def quick_scene() -> Iterator[str]:
    """The name of a scene of one's own, put into the registry as a user would."""
    SCENES["heap"] = Scene("heap", "boxes on a plane", heap, rig="gantry", sensor="sp1000")
    yield "heap"
    del SCENES["heap"]


@pytest.fixture(scope="session")
def bay_model(clean_bay: Path) -> mujoco.MjModel:
    """The bay rebuilt from what the dataset stores."""
    return mujoco.MjModel.from_xml_path(str(clean_bay / "scene" / "scene.xml"))
