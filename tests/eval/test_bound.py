"""The Cramér-Rao bound: against what registrations scatter, its scaling, and known values."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import depthba
import sim
from depthba.camera import RangeNoise
from depthba.dataset import Dataset
from depthba.errors import DatasetError
from depthba.options import Options
from depthba.run_folder import RunFolder
from eval.bound import Bound, bound
from eval.evaluate import evaluate
from eval.metrics import pose_metrics
from sim.scenes import SCENES, find_scene
from tests.depthba.analytic_scene import bumpy, cameras, ray_cast, truth_of, write_scene

SHARED = Path(__file__).parents[3] / "shared"
SPACING = 0.02
SEEDS = 6


def clean_depth(seed: int, frames: int = 5) -> list[NDArray[np.float64]]:
    return [ray_cast(T, bumpy) for T in cameras(frames, np.random.default_rng(seed))]


def stated(dataset: Dataset, sigma: float) -> Dataset:
    """The same frames, said to be that noisy."""
    sensor = replace(dataset.sensor, noise=RangeNoise(sigma))
    return replace(dataset, sensor=sensor)


def test_registrations_scatter_as_the_bound_says_and_no_less(tmp_path: Path) -> None:
    ratios = []
    for seed in range(SEEDS):
        dataset = write_scene(tmp_path / str(seed), seed=seed, noise=0.001)
        least = bound(dataset, SPACING, clean_depth(seed))
        assert least.surface == "clean"
        result = depthba.register(dataset, Options(resolution=SPACING, threads=1))
        found = {m.name: m.value for m in pose_metrics(result.T_world_camera, truth_of(dataset))}
        # with normal errors the root mean square is sqrt(pi / 2) times the mean magnitude
        scale = np.sqrt(2 / np.pi)
        ratios.append(
            [
                scale * found["translation_rmse"] / least.translation,
                scale * found["rotation_rmse"] / least.rotation,
            ]
        )
    # 24 errors a seed and kind, of which those along weak directions go together
    typical = np.sqrt(np.mean(np.square(ratios), axis=0))
    assert np.all(typical > 0.8) and np.all(typical < 1.6), typical


def test_it_grows_with_the_noise(tmp_path: Path) -> None:
    dataset = write_scene(tmp_path / "a", noise=0.0005)
    clean = clean_depth(0)
    one, three = (bound(stated(dataset, s), SPACING, clean) for s in (0.0005, 0.0015))
    assert three.translation / one.translation == pytest.approx(3.0, rel=0.02)
    assert three.rotation / one.rotation == pytest.approx(3.0, rel=0.02)
    assert one.sigma == pytest.approx(0.0005)


def test_noisy_frames_tell_the_same_as_clean_ones(tmp_path: Path) -> None:
    dataset = write_scene(tmp_path / "a", noise=0.001)
    known, fitted = bound(dataset, SPACING, clean_depth(0)), bound(dataset, SPACING)
    assert fitted.surface == "noisy"
    assert fitted.translation == pytest.approx(known.translation, rel=0.06)
    assert fitted.rotation == pytest.approx(known.rotation, rel=0.06)
    np.testing.assert_allclose(
        np.diag(fitted.covariance) / np.diag(known.covariance), 1.0, atol=0.25
    )


def test_a_simulated_dataset_is_rendered_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SCENES, "heap", find_scene("tests.sim.heaps:heap"))
    options = sim.GenerateOptions(
        frames=4, size=(80, 60), rig="gantry", sensor="sp1000", white=True, rgb=False
    )
    dataset = Dataset.open(sim.generate("heap", tmp_path / "set", options))
    assert bound(dataset, 0.08).surface == "clean"


def test_without_truth_or_stated_noise_there_is_none(tmp_path: Path) -> None:
    dataset = write_scene(tmp_path / "a")
    silent = replace(dataset, sensor=replace(dataset.sensor, noise=None))
    with pytest.raises(DatasetError, match=r"sensor\.noise"):
        bound(silent, SPACING)
    (dataset.path / "poses_true.txt").unlink()
    with pytest.raises(DatasetError, match=r"poses_true\.txt.* --truth"):
        bound(Dataset.open(dataset.path), SPACING)


def test_evaluating_a_run_tells_it_too(tmp_path: Path) -> None:
    dataset = write_scene(tmp_path / "a", noise=0.001)
    result = depthba.register(dataset, Options(resolution=SPACING, threads=1))
    folder = RunFolder.create(tmp_path / "run")
    folder.write(result, Options(resolution=SPACING), dataset)
    found = {m.name: m for m in evaluate(folder.path, bound=True)}
    mae, least = found["translation_mae"].value, found["translation_bound"].value
    assert found["translation_over_bound"].value == pytest.approx(mae / least)
    assert found["rotation_bound"].unit == "rad" and least < 0.001
    saved = json.loads((folder.path / "metrics.json").read_text())
    assert saved["bound"] == {
        "spacing": SPACING, "sigma": pytest.approx(0.001), "surface": "noisy"
    }  # fmt: skip
    assert "Cramér-Rao" in (folder.path / "report.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "spacing", "translation", "rotation"),
    [
        ("bumpy-a", 0.01, 3.7e-5, 6.6e-5),
        ("bumpy-b", 0.02, 1.3e-4, 2.35e-4),
        ("rock-field", 0.0125, 1.6e-5, 4.4e-6),
    ],
)
def test_known_values(name: str, spacing: float, translation: float, rotation: float) -> None:
    if not (SHARED / "data" / name).is_dir():
        pytest.skip(f"{SHARED.name}/data/{name} is not beside this checkout")
    least: Bound = bound(Dataset.open(SHARED / "data" / name), spacing)
    assert least.translation == pytest.approx(translation, rel=0.25)
    assert least.rotation == pytest.approx(rotation, rel=0.25)
