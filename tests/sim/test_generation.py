from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sim
from depthba.cli import main
from depthba.dataset import Dataset, verify
from depthba.errors import DatasetError, DepthbaError, OptionError

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
    said: list[tuple[int, int]] = []
    sim.generate(quick_scene, tmp_path / "cut", OPTIONS, lambda k, n, text: said.append((k, n)))
    assert contents(tmp_path / "cut") == whole
    assert said == [(2, 4), (3, 4), (4, 4)]
    sim.generate(quick_scene, tmp_path / "cut", OPTIONS)  # finished: nothing to do
    assert contents(tmp_path / "cut") == whole


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


def test_the_verb_prints_one_object(
    quick_scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "set"
    words = ["generate", quick_scene, "--out", str(out), "--size", "80x60", "--frames", "3"]
    assert main([*words, "--start-error", "0.01", "0.02", "--clean", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["path"] == str(out) and said["frames"] == 3 and said["seconds"] > 0
    assert Dataset.open(out).header["source"]["config"]["start_error"] == [0.01, 0.02]


@pytest.mark.parametrize(
    ("words", "text"),
    [(["moon"], "industrial-6"), (["industrial-6", "--size", "big"], "320x240")],
)
def test_the_verb_answers_known_errors_in_one_line(
    words: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["generate", *words, "--out", str(tmp_path / "set")]) == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("depthba: error:") and text in error


def test_the_public_names_import_nothing_heavy() -> None:
    code = "import sys, sim; assert 'mujoco' not in sys.modules and 'numpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert {"generate", "GenerateOptions"} <= set(sim.__all__)
    assert all(hasattr(sim, name) for name in sim.__all__)
