"""Run folders: whole or not at all, equal bytes for equal arrays, read back as written."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from depthba import run_folder, se3
from depthba.dataset import Dataset, DatasetWriter
from depthba.depth_map import DepthMap
from depthba.errors import RunError
from depthba.options import Options
from depthba.ply import read_ply_points
from depthba.result import FrameReport, Iteration, Result, WeakDirection
from depthba.run_folder import RunFolder, default_path, link_latest
from depthba.spread import cell_spread
from depthba.stored_run import Run

Floats = NDArray[np.float64]
SHAPE = (24, 32)
FRAMES = 3


def sloped(offset: float) -> DepthMap:
    """A slope over the three frames' views, with a hole."""
    y, x = np.mgrid[0:40, 0:60]
    heights = 0.1 * x / 60 + 0.05 * np.sin(y / 6.0) + offset
    heights[10:14, 20:25] = np.nan
    seen = np.isfinite(heights)
    T_map_world = se3.make(se3.exp_so3([0.1, 0.0, 0.2]), [0.1, 0.2, 0.3])
    sigma = np.where(seen, 1e-3, np.nan)
    return DepthMap(heights, (-0.5, -0.4), 0.02, T_map_world, 5 * seen.astype(np.int64), sigma)


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """Three small frames that look down on a slope."""
    sensor = {
        "kind": "depth",
        "model": "made",
        "width": SHAPE[1],
        "height": SHAPE[0],
        "fx": 40.0,
        "fy": 40.0,
        "cx": 15.5,
        "cy": 11.5,
        "distortion": [0, 0, 0, 0, 0],
        "depth_scale": 1e-4,
    }
    writer = DatasetWriter.create(
        tmp_path / "slope", {"name": "slope", "sensor": sensor, "map_frame": "world"}
    )
    for i in range(FRAMES):
        depth = np.full(SHAPE, 1.0) + 0.001 * np.arange(SHAPE[1])
        depth[:3] = np.nan
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] = [0.1 * i, 0.0, 1.0]
        rgb = np.full((*SHAPE, 3), 50 + 50 * i, np.uint8)
        writer.add_frame(stamp=1.5 * i, depth=depth, rgb=rgb, T_world_camera=T)
    return Dataset.open(tmp_path / "slope")


@pytest.fixture
def result(dataset: Dataset) -> Result:
    """A result with everything in it, NaN too."""
    T_start = dataset.T_world_camera_measured
    T = se3.retract(T_start, np.random.default_rng(0).normal(size=(FRAMES, 6)) * 1e-3)
    step = Iteration(
        0, 0, 1, 0.02, "robust", 1.5, 1e-3, 2e-3, 0.0, True, 0.9, float("nan"), 7, 0.2, T, sloped(0)
    )
    return Result(
        status="weak",
        reason="yaw is open",
        frame_ids=(0, 1, 2),
        stamps=(0.0, 1.5, 3.0),
        T_world_camera=T,
        T_world_camera_start=T_start,
        depth_map=sloped(0.0),
        depth_map_start=sloped(0.01),
        covariance=np.arange(18.0 * 18.0).reshape(18, 18),
        sigma=1e-3,
        inflation=3.0,
        history=(step,),
        weak=(WeakDirection(1, "yaw", np.eye(6)[5], 0.4, 0.05, 0.02),),
        frames=tuple(FrameReport(i, 700, 0.9, 0.8, 1e-3, 2e-3, "") for i in range(FRAMES)),
        seconds={"total": 1.0},
        overlap=np.eye(3),
    )


def test_what_is_written_is_read_again(tmp_path: Path, dataset: Dataset, result: Result) -> None:
    options = Options(roi=(-2.0, 2.0, -2.0, 2.0, -2.0, 2.0), resolution=0.02)
    RunFolder.create(tmp_path / "run").write(result, options, dataset)
    run = Run.open(tmp_path / "run")
    assert_allclose(run.T_world_camera, result.T_world_camera, atol=1e-11)
    assert run.T_world_camera_start is not None and run.depth_map_start is not None
    assert_allclose(run.T_world_camera_start, result.T_world_camera_start, atol=1e-11)
    assert_array_equal(run.stamps, result.stamps)
    assert run.covariance is not None
    assert_array_equal(run.covariance, result.covariance)
    for now, then in (
        (run.depth_map, result.depth_map),
        (run.depth_map_start, result.depth_map_start),
    ):
        assert now.origin == then.origin and now.spacing == then.spacing
        for name in ("heights", "T_map_world", "count", "sigma"):
            assert_array_equal(getattr(now, name), getattr(then, name), err_msg=name)
    assert run.config["roi"] == list(options.roi or ()) and run.config["resolution"] == 0.02
    assert run.dataset_path == Path(dataset.path).resolve()
    assert run.result["status"] == "weak" and run.result["weak"][0]["name"] == "yaw"
    assert run.result["history"][0]["cost"] == 1.5
    assert run.result["history"][0]["sigma"] is None  # JSON has no NaN
    assert "depth_map" not in run.result["history"][0]

    with np.load(tmp_path / "run" / "covariance.npz") as arrays:
        assert_array_equal(arrays["frames"][1], result.covariance[6:12, 6:12])
    assert cv2.imread(str(tmp_path / "run" / "map.png")) is not None
    cloud = read_ply_points(tmp_path / "run" / "cloud.ply")
    assert len(cloud) == FRAMES * (SHAPE[0] - 3) * SHAPE[1]
    files = {p.name for p in (tmp_path / "run").iterdir()}
    assert files >= {"config.yaml", "poses_start.txt", "map_start.npz"}
    assert not [name for name in files if name.startswith(".") or name.endswith("part")]


def test_equal_arrays_give_equal_bytes(tmp_path: Path, dataset: Dataset, result: Result) -> None:
    RunFolder.create(tmp_path / "a").write(result, Options(), dataset)
    time.sleep(2.1)  # the clock of a zip archive has steps of two seconds
    RunFolder.create(tmp_path / "b").write(result, Options(), dataset)
    for name in ("map.npz", "map_start.npz", "covariance.npz", "poses.txt", "cloud.ply"):
        a, b = ((tmp_path / run / name).read_bytes() for run in "ab")
        assert a == b, name
    assert run_folder.map_bytes(sloped(1e-15)) != (tmp_path / "a/map.npz").read_bytes()


def test_a_folder_in_the_way_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="is a file"):
        RunFolder.create(tmp_path / "file")
    RunFolder.create(tmp_path / "empty")
    RunFolder.create(tmp_path / "empty")
    (tmp_path / "full").mkdir()
    for name in ("mine.txt", "report.md", "run.rrd"):
        (tmp_path / "full" / name).write_text("")
    with pytest.raises(RunError, match="--overwrite"):
        RunFolder.create(tmp_path / "full")
    RunFolder.create(tmp_path / "full", overwrite=True)
    assert [p.name for p in (tmp_path / "full").iterdir()] == ["mine.txt"]


def test_a_run_that_is_not_whole_is_refused(
    tmp_path: Path, dataset: Dataset, result: Result
) -> None:
    whole = RunFolder.create(tmp_path / "whole")
    whole.write(result, Options(), dataset)
    for k, (name, content, said) in enumerate(
        [
            ("result.json", None, "result.json: missing"),
            ("result.json", b"{", "not readable"),
            ("result.json", b'{"format": "other"}', "depthba-run"),
            ("map.npz", b"PK", "not a whole run folder"),
            ("poses.txt", None, "poses.txt"),
        ]
    ):
        run = Path(shutil.copytree(whole.path, tmp_path / f"broken-{k}"))
        if content is None:
            (run / name).unlink()
        else:
            (run / name).write_bytes(content)
        with pytest.raises(RunError, match=said):
            Run.open(run)


def test_the_newest_run_is_linked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = default_path("my set/1")
    assert first.parent == Path("logs") and first.name.startswith("my-set-1-")
    first.mkdir(parents=True)
    link_latest(first)
    assert Path("logs/latest").resolve() == first.resolve()
    again = default_path("my set/1")
    assert again != first
    nested = again / "default"
    nested.mkdir(parents=True)
    link_latest(nested)
    assert Path("logs/latest").resolve() == nested.resolve()
    link_latest(tmp_path)  # in no logs: nothing to do
    assert Path("logs/latest").resolve() == nested.resolve()


def test_a_large_cloud_is_thinned_and_keeps_its_colours(
    dataset: Dataset, result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    from depthba.clouds import load_clouds

    monkeypatch.setattr(run_folder, "CLOUD_POINTS", 500)
    points, colours = run_folder.merged_cloud(result, Options(), load_clouds(dataset))
    assert 50 < len(points) <= 500 and points.dtype == np.float32
    assert colours.min() >= 50 and colours.max() <= 150 and len(np.unique(colours[:, 0])) > 1
    grey = load_clouds(dataset, colours=False)
    cropped, tints = run_folder.merged_cloud(result, Options(roi=(0.0, 0.3, -1, 1, -9, 9)), grey)
    at = cropped @ result.depth_map.T_map_world[:3, :3].T + result.depth_map.T_map_world[:3, 3]
    assert len(cropped) and at[:, 0].min() > -0.02 and at[:, 0].max() < 0.32
    assert len(np.unique(tints, axis=0)) > 5


def test_spread_is_the_median_deviation_in_each_cell() -> None:
    rng = np.random.default_rng(1)
    cell = 0.1
    frames = [rng.uniform(0, 1, size=(n, 3)) for n in (400, 300, 0, 500, 250)]
    found = cell_spread(frames, cell)
    low = np.min([p[:, :2].min(axis=0) for p in frames if len(p)], axis=0)
    image = found.image()
    checked = 0
    for ix in range(10):
        for iy in range(10):
            means = []
            for p in frames:
                here = np.all(np.floor((p[:, :2] - low) / cell) == [ix, iy], axis=1)
                if here.any():
                    means.append(p[here, 2].mean())
            if len(means) < 2:
                assert not np.isfinite(image[iy, ix])
                continue
            expected = 1.4826 * np.median(np.abs(np.array(means) - np.median(means)))
            assert_allclose(image[iy, ix], expected, rtol=1e-9)
            checked += 1
    assert checked > 50
    assert_allclose(found.quantile(0.5), np.median(found.shared))
    assert np.isnan(cell_spread([np.zeros((0, 3))], cell).quantile(0.5))
