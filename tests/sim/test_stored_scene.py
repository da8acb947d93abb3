"""A scene that comes with a dataset reads nothing but what lies beside it, and calls nothing."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

import sim
from depthba.dataset import Dataset
from depthba.errors import DatasetError
from eval.bound import rendered
from eval.true_map import TrueSurface
from sim import stored_scene

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
MODEL = """<mujoco>{top}<asset><mesh name="m" file="{file}"/></asset>
<worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>"""


def scene(path: Path, file: str = "m.obj", top: str = "", head: str = "") -> Path:
    """Write a scene of one mesh, which lies beside it, in it, and elsewhere."""
    inside = path / "set" / "scene"
    (inside / "deep").mkdir(parents=True)
    for folder in (path, path / "set", inside, inside / "deep"):
        (folder / "m.obj").write_text(TETRAHEDRON)
    (inside / "link.obj").symlink_to(path / "m.obj")
    text = MODEL.format(file=file.replace("HERE", str(path)), top=top.replace("HERE", str(path)))
    (inside / "scene.xml").write_text(head + text)
    return path / "set"


def test_files_beside_it_are_read(tmp_path: Path) -> None:
    xml, files = stored_scene.read(scene(tmp_path))
    assert files == {"m.obj": TETRAHEDRON.encode()} and "mesh" in xml
    TrueSurface(tmp_path / "set")


OUTSIDE = {
    "absolute": {"file": "HERE/m.obj"},
    "above": {"file": "../m.obj"},
    "below": {"file": "deep/m.obj"},
    "a link": {"file": "link.obj"},
    "not there": {"file": "none.obj"},
    "a folder of meshes": {"top": '<compiler meshdir="HERE"/>'},
    "a folder of all": {"top": '<compiler assetdir=".."/>'},
    "included": {"top": '<include file="m.obj"/>'},
    "a plugin": {"top": '<extension><plugin plugin="mujoco.elasticity.cable"/></extension>'},
    "sides of a sky": {"top": '<asset><texture type="skybox" fileup="HERE/up.png"/></asset>'},
    "an entity": {"head": '<!DOCTYPE m [<!ENTITY e "m.obj">]>', "file": "&e;"},
    "no XML": {"head": "<mujoco"},
    "no model": {"top": "<nothing/>"},
}


@pytest.mark.parametrize("how", OUTSIDE.values(), ids=OUTSIDE)
def test_anything_else_is_refused_in_one_line(tmp_path: Path, how: dict[str, str]) -> None:
    path = scene(tmp_path, **how)
    with pytest.raises(DatasetError, match=r"scene.*expected") as caught:
        TrueSurface(path)
    assert "\n" not in str(caught.value)


def test_a_scene_that_is_itself_a_link_is_refused(tmp_path: Path) -> None:
    path = scene(tmp_path)
    os.rename(path / "scene", tmp_path / "elsewhere")
    (path / "scene").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DatasetError, match="a link"):
        stored_scene.read(path)


def test_a_function_that_a_dataset_names_is_not_called(tmp_path: Path) -> None:
    options = sim.GenerateOptions(seed=5, frames=2, size=(32, 24), rgb=False)
    path = sim.generate("industrial-6", tmp_path / "set", options)
    assert (before := rendered(Dataset.open(path), Dataset.open(path).T_world_camera_true))
    assert len(before) == 2
    header = json.loads((path / "dataset.json").read_text())
    header["source"]["scene"] = "os:abort"  # would end this very process
    (path / "dataset.json").write_text(json.dumps(header))
    dataset = Dataset.open(path)
    assert rendered(dataset, dataset.T_world_camera_true) is None
