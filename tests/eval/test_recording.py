"""Recordings: what is in them, how large they get, and that none is left half-written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rerun.chunk import RrdReader

from depthba import se3
from depthba.clouds import FrameCloud
from depthba.dataset import Dataset
from depthba.options import Options
from depthba.result import Result, WeakDirection
from eval.evaluate import evaluate
from eval.metrics import Metric
from eval.recorded_certainty import round_factor
from eval.recorded_residuals import BINS, histogram, residuals
from eval.recording import Recorder
from tests.eval.conftest import made_result, write_scene

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
        "/cam/0/residual",
        "/histogram/0",
        "/certainty/surface",
        "/certainty/picture",
        "/certainty/ellipsoids",
        "/certainty/open",
        "/figures",
    }
    assert not expected - found
    assert len(RrdReader(recording).blueprints()) == 1
    page = column(chunks(recording, "/figures"), "TextDocument:text")[0][0]
    assert "Translation error | 10.0 mm | **0.100 mm**" in page
    assert "yaw" in page and "too little overlap" in page


def test_points_are_tinted_by_their_residual(
    recording: Path, dataset: Dataset, result: Result
) -> None:
    """Blue below the map, red above it: as computed again from the points that were recorded."""
    batches = chunks(recording, "/cam/4/residual")
    points = np.array(column(batches, "Points3D:positions")[0])
    last = len(result.history) + 1
    tints = next(
        np.array(v)
        for b in batches
        if "Points3D:colors" in b.schema.names
        for k, v in zip(
            b.column("iteration").to_pylist(), b.column("Points3D:colors").to_pylist(), strict=True
        )
        if k == last
    )
    r = residuals(result.depth_map, result.T_world_camera[4], points)
    red, blue = (tints >> 24) & 255, (tints >> 8) & 255
    some = np.abs(r) > 1e-4
    assert len(tints) == len(points) and some.sum() > 100
    assert np.all((red > blue)[some] == (r > 0)[some])


def test_histograms_stand_side_by_side(recording: Path, result: Result) -> None:
    for i in (0, 3):
        batches = chunks(recording, f"/histogram/{i}")
        shares = np.array(column(batches, "BarChart:values")[-1][0]["buffer"])
        places = np.array(column(batches, "BarChart:abscissa")[-1][0]["buffer"])
        assert len(shares) == len(places) == BINS
        assert_allclose(shares.sum(), 100.0)
        assert places.min() > i - 0.5 and places.max() < i + 0.5
        when = [k for b in batches for k in b.column("iteration").to_pylist()]
        assert sorted(when) == list(range(len(result.history) + 2))
    values, found, _ = histogram(7, np.array([-9.0, 0.05, np.nan, 9.0]), 1.0)
    assert_allclose(values.mean(), 7.0)
    assert_allclose(found[[0, -1]], 100 / 3)  # what is beyond counts at the ends


def test_ellipsoids_are_enlarged_by_what_the_title_says(
    recording: Path, dataset: Dataset, result: Result
) -> None:
    batches = chunks(recording, "/certainty/ellipsoids")
    half = np.array(column(batches, "Ellipsoids3D:half_sizes")[0])
    centres = np.array(column(batches, "Ellipsoids3D:centers")[0])
    # frame 0 is fixed; one standard deviation is 0.1 mm; the cameras count as 0.24 m apart
    assert_allclose(centres, result.T_world_camera[1:, :3, 3], atol=1e-6)
    assert_allclose(half, 500 * 1e-4, rtol=1e-5)
    titles = column(
        [
            c.to_record_batch()
            for c in RrdReader(recording).stream(store=RrdReader(recording).blueprints()[0])
        ],
        "ViewBlueprint:display_name",
    )
    assert ["Certainty: σ × 500, arrows: open"] in titles


def test_an_ellipsoid_lies_along_the_covariance(
    tmp_path: Path, dataset: Dataset, result: Result
) -> None:
    """A long thin ellipsoid, turned; and one that would fill the view is cut, and red."""
    T = se3.make(se3.exp_so3([0.3, -0.5, 0.8]), np.zeros(3))[:3, :3]
    covariance = result.covariance.copy()
    covariance[6:9, 6:9] = T @ np.diag([4e-8, 1e-10, 1e-8]) @ T.T
    covariance[12:15, 12:15] = np.eye(3) * 1e-4
    path = record(tmp_path / "run.rrd", dataset, replace(result, covariance=covariance), None)
    batches = chunks(path, "/certainty/ellipsoids")
    half = np.array(column(batches, "Ellipsoids3D:half_sizes")[0])
    q = np.array(column(batches, "Ellipsoids3D:quaternions")[0])
    R = se3.from_quaternion(np.zeros(3), q[0])[:3, :3]
    # 500: the median frame's 0.1 mm becomes a fifth of the distance of the cameras
    drawn = R @ np.diag(half[0] ** 2) @ R.T
    assert_allclose(drawn / 500**2, covariance[6:9, 6:9], atol=2e-10)
    assert_allclose(half[1], 0.9 * 0.24, rtol=0.01)
    tints = np.array(column(batches, "Ellipsoids3D:colors")[0])
    assert (tints[1] >> 8).item() == 0xFF3C3C


@pytest.mark.parametrize(("factor", "expected"), [(999.0, 500.0), (1000.0, 1000.0), (0.3, 0.2)])
def test_factors_are_round(factor: float, expected: float) -> None:
    assert_allclose(round_factor(factor), expected)


def test_open_directions_are_arrows_in_the_world(
    tmp_path: Path, dataset: Dataset, result: Result
) -> None:
    """A direction is given in the map's axes; the map lies askew."""
    R = se3.exp_so3([0.0, 0.0, 0.7])
    T_map_world = se3.make(R, np.array([0.1, 0.2, 0.0]))
    along = np.array([0.6, 0.0, 0.0, 0.0, 0.8, 0.0])
    weak = WeakDirection(4, "x + turn about y", along, 0.4, 0.05, 0.002)
    moved = replace(result.depth_map, T_map_world=T_map_world)
    path = record(
        tmp_path / "run.rrd", dataset, replace(result, depth_map=moved, weak=(weak,)), None
    )
    batches = chunks(path, "/certainty/open")
    vectors = np.array(column(batches, "Arrows3D:vectors")[0])
    origins = np.array(column(batches, "Arrows3D:origins")[0])
    centre = result.T_world_camera[4, :3, 3]
    assert_allclose(origins, [centre, centre], atol=1e-6)
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    assert_allclose(unit, [R.T @ [1, 0, 0], R.T @ [0, 1, 0]], atol=1e-6)
    assert_allclose(np.linalg.norm(vectors[0]) / np.linalg.norm(vectors[1]), 0.6 / 0.8, rtol=1e-5)


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


def test_twenty_large_frames_stay_small(tmp_path: Path) -> None:
    """20 frames of 50 000 points each on a map of a quarter of a million nodes, 15 iterations.

    Nothing of it can be compressed, and all of it changes in every iteration.
    """
    rng = np.random.default_rng(0)
    dataset = write_scene(tmp_path / "many", 20)
    clouds = [
        FrameCloud(rng.uniform([-2, -2, 0.9], [2, 2, 1.1], (50_000, 3)), None) for _ in range(20)
    ]
    recorder = Recorder(tmp_path / "run.rrd", dataset, Options(), clouds)
    made = made_result(dataset, dataset.T_world_camera_measured, 1)
    heights = rng.normal(size=(500, 500))
    big = replace(
        made.depth_map, heights=heights, count=np.ones((500, 500), np.int64), sigma=heights**2
    )
    for k in range(15):
        changed = replace(big, heights=heights + k)
        recorder(replace(made.history[0], index=k, depth_map=changed))
    recorder.finish(replace(made, depth_map=big, depth_map_start=big))
    assert (tmp_path / "run.rrd").stat().st_size < 20e6


def test_a_registration_that_fails_leaves_no_recording(
    tmp_path: Path, dataset: Dataset, result: Result
) -> None:
    recorder = Recorder(tmp_path / "run.rrd", dataset, Options())
    recorder(result.history[0])
    recorder.discard()
    assert list(tmp_path.iterdir()) == []
