"""Recordings: what is in them, how large they get, and that none is left half-written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rerun.chunk import RrdReader

from depthba.dataset import Dataset
from depthba.options import Options
from depthba.result import Result
from eval.evaluate import evaluate
from eval.metrics import Metric
from eval.recording import Recorder

FIGURES = [
    Metric("translation_mae", "m", "lower", 1e-4),
    Metric("start_translation_mae", "m", "lower", 1e-2),
]


def record(path: Path, dataset: Dataset, result: Result, metrics: list[Metric] | None) -> Path:
    recorder = Recorder(path, dataset, Options())
    for iteration in result.history:
        recorder(iteration)
    assert not path.exists()  # not before it is whole
    recorder.finish(result, metrics)
    return path


def chunks(path: Path, *content: str) -> list[Any]:
    return [c.to_record_batch() for c in RrdReader(path).stream().filter(content=list(content))]


def column(batches: list[Any], name: str) -> list[Any]:
    return [v for b in batches if name in b.schema.names for v in b.column(name).to_pylist()]


def entities(path: Path) -> set[str]:
    return {
        b.schema.metadata[b"rerun:entity_path"].decode()
        for b in chunks(path, "/**", "/__properties/**")
    }


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, dataset: Dataset, result: Result) -> Path:
    return record(tmp_path_factory.mktemp("rec") / "run.rrd", dataset, result, FIGURES)


def test_poses_by_iteration_end_at_the_estimate(
    recording: Path, dataset: Dataset, result: Result
) -> None:
    batches = chunks(recording, "/cam/2")
    at = {}
    for b in batches:
        for k, t in zip(
            b.column("iteration").to_pylist(),
            b.column("Transform3D:translation").to_pylist(),
            strict=True,
        ):
            at[k] = t[0]
    assert sorted(at) == list(range(len(result.history) + 2))  # start, steps, result
    assert_allclose(at[0], result.T_world_camera_start[2, :3, 3], atol=1e-6)
    assert_allclose(at[len(result.history) + 1], result.T_world_camera[2, :3, 3], atol=1e-6)


def test_everything_is_there_to_be_looked_at(recording: Path) -> None:
    found = entities(recording)
    expected = {
        "/cam/0",
        "/cam/0/points",
        "/cam/0/image",
        "/before/0",
        "/before/0/points",
        "/map/surface",
        "/map/picture",
        "/spread/before",
        "/spread/after",
        "/centres/start",
        "/centres/true",
        "/curves/cost/cost",
        "/curves/step/translation",
        "/curves/sigma/sigma",
        "/curves/error/rotation",
        "/residual/0",
        "/figures",
    }
    assert not expected - found
    assert len(RrdReader(recording).blueprints()) == 1
    page = column(chunks(recording, "/figures"), "TextDocument:text")[0][0]
    assert "Translation error | 10.0 mm | **0.100 mm**" in page
    assert "yaw" in page and "too little overlap" in page


def test_a_level_change_brings_new_triangles(recording: Path) -> None:
    """Vertices alone within a level; the other grid of the next level needs its own triangles."""
    batches = chunks(recording, "/map/surface")
    when = [
        k
        for b in batches
        if "Mesh3D:triangle_indices" in b.schema.names
        for k, v in zip(
            b.column("iteration").to_pylist(),
            b.column("Mesh3D:triangle_indices").to_pylist(),
            strict=True,
        )
        if v
    ]
    assert sorted(when) == [0, 1, 3, 5]  # start, both levels, result


def test_properties_can_be_asked_of_many_recordings(recording: Path, dataset: Dataset) -> None:
    run = chunks(recording, "/__properties/run")[0]
    facts = {n: run.column(n).to_pylist()[0][0] for n in ("dataset", "preset", "seed", "status")}
    assert facts == {"dataset": "waves", "preset": "default", "seed": 5, "status": "weak"}
    assert column(chunks(recording, "/__properties/metrics"), "translation_mae") == [[1e-4]]
    assert str(dataset.path) not in str(facts)


def test_evaluate_adds_the_figures_to_a_recording(
    run: Path, dataset: Dataset, result: Result
) -> None:
    path = record(run / "run.rrd", dataset, result, None)
    identity = RrdReader(path).recordings()[0].recording_id
    assert "Not judged yet" in column(chunks(path, "/figures"), "TextDocument:text")[-1][0]
    metrics = {m.name: m.value for m in evaluate(run)}
    assert [e.recording_id for e in RrdReader(path).recordings()] == [identity]
    assert len(RrdReader(path).blueprints()) == 1
    pages = column(chunks(path, "/figures"), "TextDocument:text")
    assert any("Translation error" in page[0] for page in pages)
    found = column(chunks(path, "/__properties/metrics"), "translation_mae")
    assert_allclose(found[-1], [metrics["translation_mae"]])
    assert {p.name for p in run.iterdir() if p.name.startswith(".")} == set()


def test_twenty_large_frames_stay_small(tmp_path: Path, dataset: Dataset, result: Result) -> None:
    """A map of a quarter of a million nodes, recorded 18 times as it changes."""
    rng = np.random.default_rng(0)
    recorder = Recorder(tmp_path / "run.rrd", dataset, Options())
    big = result.depth_map
    heights = rng.normal(size=(500, 500))
    last = result.history[-1]
    for k in range(18):
        depth_map = replace(
            big, heights=heights + k, count=np.ones((500, 500), np.int64), sigma=heights
        )
        recorder(replace(last, index=k, depth_map=depth_map))
    recorder.finish(result)
    size = (tmp_path / "run.rrd").stat().st_size
    cloud = 2 * 12 * 160_000  # what the points of large frames may take besides
    assert size + cloud < 20e6


def test_a_registration_that_fails_leaves_no_recording(
    tmp_path: Path, dataset: Dataset, result: Result
) -> None:
    recorder = Recorder(tmp_path / "run.rrd", dataset, Options())
    recorder(result.history[0])
    recorder.discard()
    assert list(tmp_path.iterdir()) == []
