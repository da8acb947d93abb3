from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import sim
from depthba.dataset import Dataset, verify
from depthba.errors import DatasetError, DepthbaError, OptionError
from sim.engine import mujoco
from sim.errors import SimulationError

OPTIONS = sim.GenerateOptions(seed=1, frames=4, size=(80, 60))


def contents(path: Path) -> dict[str, bytes]:
    files = sorted(p for p in path.rglob("*") if p.is_file())
    return {str(p.relative_to(path)): p.read_bytes() for p in files}


def test_equal_seeds_give_equal_bytes(quick_scene: str, tmp_path: Path) -> None:
    one, two, other = (
        contents(sim.generate(quick_scene, tmp_path / name, replace(OPTIONS, seed=seed)))
        for name, seed in (("one", 1), ("two", 1), ("other", 2))
    )
    assert one == two
    changed = {name for name in one if one[name] != other[name]}
    assert {
        "scene/scene.xml",
        "depth/000000.png",
        "rgb/000000.png",
        "poses_measured.txt",
    } <= changed
    assert "poses_true.txt" not in changed


def test_a_dataset_cut_short_is_resumed_to_the_same_bytes(quick_scene: str, tmp_path: Path) -> None:
    class CrashError(Exception):
        pass

    def crash(done: int, total: int, text: str) -> None:
        if done == 2:
            raise CrashError

    whole = contents(sim.generate(quick_scene, tmp_path / "whole", OPTIONS))
    with pytest.raises(CrashError):
        sim.generate(quick_scene, tmp_path / "cut", OPTIONS, crash)
    assert len(Dataset.open(tmp_path / "cut")) == 2 and verify(tmp_path / "cut") == []
    assert not sim.is_complete(quick_scene, tmp_path / "cut", OPTIONS)
    said: list[tuple[int, int]] = []
    sim.generate(quick_scene, tmp_path / "cut", OPTIONS, lambda k, n, text: said.append((k, n)))
    assert contents(tmp_path / "cut") == whole
    assert said == [(0, 0), (2, 4), (3, 4), (4, 4)]
    assert sim.is_complete(quick_scene, tmp_path / "cut", OPTIONS)
    said.clear()
    sim.generate(quick_scene, tmp_path / "cut", OPTIONS, lambda k, n, text: said.append((k, n)))
    assert said == [(4, 4)]  # finished: nothing to do
    assert contents(tmp_path / "cut") == whole
    assert not sim.is_complete(quick_scene, tmp_path / "cut", replace(OPTIONS, seed=2))


def test_a_dataset_is_rebuilt_from_what_it_says_of_itself(quick_scene: str, tmp_path: Path) -> None:
    options = replace(OPTIONS, frames=2, start_error=(0.02, 0.01), without=("range-limits",))
    first = sim.generate(quick_scene, tmp_path / "first", options)
    assert contents(sim.rebuild(first, tmp_path / "again")) == contents(first)
    header = json.loads((first / "dataset.json").read_text())
    assert set(header["source"]["versions"]) == {"mujoco", "embreex", "numpy", "scipy"}
    header["source"]["versions"]["numpy"] = "1.0"
    (first / "dataset.json").write_text(json.dumps(header))
    with pytest.raises(DatasetError, match=r"numpy 1\.0.*expected the same"):
        sim.rebuild(first, tmp_path / "other")
    del header["source"]["config"]
    (first / "dataset.json").write_text(json.dumps(header))
    with pytest.raises(DatasetError, match="no scene and config"):
        sim.rebuild(first, tmp_path / "other")
    assert not (tmp_path / "other").exists()


@pytest.fixture
def own_model(tmp_path: Path) -> Path:
    """An MJCF file with a mesh, a texture and a loose ball beside it."""
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "tent.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0.2 0.2 0.5\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    )
    tile = np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)
    assert cv2.imwrite(str(tmp_path / "tile.png"), tile)
    model = tmp_path / "yard.xml"
    model.write_text(
        """<mujoco model="yard"><compiler meshdir="meshes"/><asset><mesh file="tent.obj"/>
        <texture name="t" type="2d" file="meshes/../tile.png"/><material name="m" texture="t"/>
        </asset><worldbody><geom type="plane" size="3 3 .1" material="m"/>
        <geom type="mesh" mesh="tent" pos="0.1 0.2 0"/>
        <body pos="-0.5 0 0.2"><freejoint/><geom size="0.2"/></body></worldbody></mujoco>"""
    )
    return model


def test_an_mjcf_file_is_a_scene(own_model: Path, tmp_path: Path) -> None:
    options = sim.GenerateOptions(seed=2, size=(160, 90), clean=True, frames=5, rgb=False)
    path = sim.generate(str(own_model), tmp_path / "set", options)
    assert verify(path) == []
    dataset = Dataset.open(path)
    assert dataset.header["name"] == "yard" and dataset.header["sensor"]["model"] == "zed2"
    # What is stored compiles by itself, and the points lie on it.
    model = mujoco.MjModel.from_xml_path(str(path / "scene" / "scene.xml"))
    scene = sim.RayScene.of_model(model)
    for k, frame in enumerate(dataset):
        T = dataset.T_world_camera_true[k]
        points = frame.points() @ T[:3, :3].T + T[:3, 3]
        assert len(points) > 10_000
        again = scene.cast(T[:3, 3], points - T[:3, 3]).distance
        assert np.median(np.abs(again - 1.0)) * 2.0 < 5e-5
    # Rendered anew from the stored scene alone, the frames are the same.
    own_model.unlink()
    again, first = contents(sim.rebuild(path, tmp_path / "again")), contents(path)
    assert again.keys() == first.keys()
    assert {name for name in first if again[name] != first[name]} <= {
        "dataset.json",
        "scene/scene.json",
    }
    seen = np.concatenate([frame.depth().ravel() for frame in dataset])
    assert np.ptp(seen[np.isfinite(seen)]) > 0.4  # ball and tent, not the floor alone


def test_a_scene_of_ones_own_fails_in_one_line(own_model: Path, tmp_path: Path) -> None:
    (own_model.parent / "tile.png").unlink()
    with pytest.raises(SimulationError, match=r"tile\.png.*expected the file"):
        sim.generate(str(own_model), tmp_path / "set")
    own_model.write_text("<mujoco><worldbody><geom type='egg'/></worldbody></mujoco>")
    with pytest.raises(SimulationError, match=r"yard\.xml.*egg.*expected an MJCF model"):
        sim.generate(str(own_model), tmp_path / "set")
    for scene, text in (
        ("nowhere.xml", "no such file"),
        ("nowhere:heap", "no module 'nowhere'"),
        ("tests.sim.conftest:nothing", "no 'nothing'"),
    ):
        with pytest.raises(SimulationError, match=text):
            sim.generate(scene, tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_a_function_is_a_scene(tmp_path: Path) -> None:
    options = replace(OPTIONS, rig="gantry", sensor="sp1000", rgb=False)
    path = sim.generate("tests.sim.conftest:heap", tmp_path / "set", options)
    assert Dataset.open(path).header["name"] == "heap" and verify(path) == []


def test_a_folder_with_other_things_is_refused(quick_scene: str, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    with pytest.raises(DatasetError, match="mine"):
        sim.generate(quick_scene, tmp_path / "mine", OPTIONS)
    path = sim.generate(quick_scene, tmp_path / "set", OPTIONS)
    before = contents(path)
    for other in (replace(OPTIONS, seed=9), replace(OPTIONS, clean=True)):
        with pytest.raises(DatasetError, match="another dataset"):
            sim.generate(quick_scene, path, other)
    assert contents(path) == before


def test_what_a_frame_holds(quick_scene: str, tmp_path: Path) -> None:
    path = sim.generate(quick_scene, tmp_path / "set", OPTIONS)
    assert verify(path) == []
    dataset = Dataset.open(path)
    rgb = dataset[0].rgb()
    assert rgb is not None and rgb.shape == (60, 80, 3) and rgb.std() > 5
    assert dataset.pose_noise is not None and dataset.T_flange_camera is not None
    for frame, T in zip(dataset, dataset.T_world_camera_measured, strict=True):
        assert frame.T_base_flange is not None
        np.testing.assert_allclose(frame.T_base_flange @ dataset.T_flange_camera, T, atol=1e-9)
    (marker,) = dataset.markers()
    assert [frame for frame, _ in marker.observations] == [0]
    np.testing.assert_allclose(marker.p_world, [0.2, 1.0, 0.702], atol=1e-9)


def test_a_start_error_is_the_datasets_pose_noise(quick_scene: str, tmp_path: Path) -> None:
    options = replace(OPTIONS, clean=True, rgb=False, start_error=(0.03, 0.02))
    dataset = Dataset.open(sim.generate(quick_scene, tmp_path / "set", options))
    noise = dataset.pose_noise
    assert noise is not None
    assert noise.sigma_t_m == (0.03,) * 3 and noise.sigma_r_rad == (0.02,) * 3
    assert dataset[0].rgb() is None and dataset.T_flange_camera is None
    true = dataset.T_world_camera_true
    np.testing.assert_array_equal(dataset.T_world_camera_measured[0], true[0])
    assert np.abs(dataset.T_world_camera_measured[1:] - true[1:]).max() > 0.01


def test_errors_name_the_offender_and_the_choices(tmp_path: Path) -> None:
    with pytest.raises(DepthbaError, match=r"'moon'.*industrial-6"):
        sim.generate("moon", tmp_path / "set")
    for wrong in ({"frames": 0}, {"seed": -1}, {"pose_noise": -1.0}):
        with pytest.raises(OptionError, match=next(iter(wrong))):
            sim.GenerateOptions(**wrong)
    assert not (tmp_path / "set").exists()


def test_the_public_names_import_nothing_heavy() -> None:
    code = "import sys, sim; assert 'mujoco' not in sys.modules and 'numpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert {"generate", "GenerateOptions"} <= set(sim.__all__)
    assert all(hasattr(sim, name) for name in sim.__all__)
