"""Map and marker figures on surfaces and markers where the answer is known."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

import sim
from depthba import se3
from depthba.clouds import load_clouds
from depthba.dataset import Dataset, Marker
from depthba.depth_map import DepthMap
from depthba.options import Options
from depthba.result import Result
from depthba.run_folder import RunFolder
from eval.evaluate import judge
from eval.map_metrics import (
    REACHES,
    Patches,
    cloud_metrics,
    height_metrics,
    patches,
    seen_nodes,
)
from eval.marker_metrics import marker_metrics
from eval.metrics import Metric
from eval.report import report
from eval.true_map import TrueSurface

Floats = NDArray[np.float64]


def values(metrics: list[Metric]) -> dict[str, float]:
    return {m.name: m.value for m in metrics}


def test_heights_of_a_tilted_map() -> None:
    """A map that leans by a known slope, with a hole, and a part that nobody asks for."""
    x = np.tile(0.01 * np.arange(101), (50, 1))
    true, found = 0.3 * x, 0.35 * x  # errors evenly from 0 to 0.05
    expected = np.ones(x.shape, dtype=bool)
    got = values(height_metrics(found, true, expected, 0.01))
    assert_allclose(got["map_rmse"], 0.05 / np.sqrt(3), rtol=0.01)
    assert_allclose(got["map_p95"], 0.05 * 0.95, rtol=1e-9)
    share = {k: min(k * 0.01 / 0.05, 1.0) for k in REACHES}
    assert_allclose([got[f"map_complete_{k}x"] for k in REACHES], list(share.values()), atol=0.01)

    found[:, :51] = np.nan  # a hole is not complete, and has no error
    expected[:25] = False
    found[:25] = 9.0
    got = values(height_metrics(found, true, expected, 0.01))
    assert_allclose(got["map_complete_5x"], 50 / 101)
    assert_allclose(got["map_rmse"], np.sqrt(np.mean((0.05 * x[0, 51:]) ** 2)))
    true[:] = np.nan
    assert all(np.isnan(v) for v in values(height_metrics(found, true, expected, 0.01)).values())


def plane(side: int, spacing: float, z: float = 0.0) -> Floats:
    x, y = np.meshgrid(spacing * np.arange(side), spacing * np.arange(side))
    return np.stack([x, y, np.full(x.shape, z)], axis=-1).reshape(-1, 3)


def test_distances_of_clouds() -> None:
    """Two planes 3 mm apart; then one of them twice as long, which only Chamfer minds."""
    below, above = plane(60, 0.01), plane(60, 0.01, 3e-3)
    got = values(cloud_metrics(above, below))
    assert_allclose([got["cloud_to_cloud"], got["chamfer"]], [3e-3, 6e-3])
    longer = np.concatenate([below, below + np.array([0.6, 0, 0])])
    got = values(cloud_metrics(below, longer))
    assert_allclose(got["cloud_to_cloud"], 0.0, atol=1e-12)
    # 0.01 to 0.6 in steps of 0.01, over twice as many points
    assert_allclose(got["chamfer"], np.arange(1, 61).mean() * 0.01 / 2)
    assert np.isnan(values(cloud_metrics(below, np.empty((0, 3))))["chamfer"])


def test_entropy_and_thickness_of_a_noisy_plane() -> None:
    """Points even in a disc of radius r: variance r^2 / 4 along it, the noise's across."""
    rng = np.random.default_rng(0)
    sigma, radius = 1e-3, 0.05
    frames = [rng.uniform(-1, 1, (60_000, 3)) * [1, 1, 0] for _ in range(2)]
    frames = [p + rng.normal(size=p.shape) * [0, 0, sigma] for p in frames]
    tilt = np.stack([np.eye(4), se3.make(se3.exp_so3([0.3, 0.1, 0.2]), [1.0, 2.0, 3.0])])
    local = [(p - T[:3, 3]) @ T[:3, :3] for p, T in zip(frames, tilt, strict=True)]
    found = patches(local, tilt, radius)
    assert found.frames.min() == 2
    inner = Patches(found.eigenvalues, found.frames)
    got = values(inner.metrics())
    assert_allclose(got["patch_thickness"], sigma, rtol=0.03)
    expected = 0.5 * np.log((2 * np.pi * np.e) ** 3 * (radius**2 / 4) ** 2 * sigma**2)
    assert_allclose(got["mean_map_entropy"], expected, atol=0.06)  # discs are cut at the rim

    off = tilt.copy()
    off[1, 2, 3] += 6e-3  # frames apart by d: the noise's variance and d^2 / 4
    apart = values(patches(local, off, radius).metrics())
    assert_allclose(apart["patch_thickness"], np.hypot(sigma, 3e-3), rtol=0.03)
    assert apart["mean_map_entropy"] > got["mean_map_entropy"] + 0.5
    alone = values(patches(local[:1], tilt[:1], radius).metrics())
    assert np.isnan(alone["patch_thickness"])  # one frame cannot disagree
    none = values(patches([np.empty((0, 3))], tilt[:1], radius).metrics())
    assert np.isnan(none["mean_map_entropy"])


def test_nodes_that_a_point_belongs_to() -> None:
    T_map_world = se3.make(se3.exp_so3([0, 0, np.pi / 2]), [0.0, 0.0, 5.0])
    world = [np.array([[0.1, -0.2, 7.0], [9.0, 9.0, 0.0]])]  # at map 0.2, 0.1
    seen = seen_nodes(world, T_map_world, (-0.1, 0.0), 0.1, (3, 5))
    assert np.argwhere(seen).tolist() == [[1, 3]]


def markers(T_true: Floats) -> list[Marker]:
    """Three markers, each seen exactly by two of four frames."""
    at = {"origin": [0.0, 0, 0], "far_x": [7.0, 0, 0], "far_y": [0, 6.0, 0]}
    seen_by = {"origin": (10, 11), "far_x": (11, 13), "far_y": (12, 13)}
    found = []
    for name, p in at.items():
        p_world = np.array(p)
        seen = [(k, se3.inverse(T_true[k - 10])[:3] @ [*p, 1.0]) for k in seen_by[name]]
        found.append(Marker(name, p_world, tuple(seen)))
    return found


def test_marker_distances() -> None:
    rng = np.random.default_rng(1)
    T_true = se3.make(se3.exp_so3(rng.normal(size=(4, 3))), rng.normal(size=(4, 3)))
    ids = (10, 11, 12, 13)
    exact = values(marker_metrics(markers(T_true), ids, T_true))
    assert list(exact) == ["marker_error_x", "marker_error_y"]
    assert_allclose(list(exact.values()), 0.0, atol=1e-12)

    T_est = T_true.copy()
    T_est[3, 0, 3] += 0.02  # one of the two frames that see far_x, and far_y
    off = values(marker_metrics(markers(T_true), ids, T_est))
    assert_allclose(off["marker_error_x"], 0.01, atol=1e-9)
    assert_allclose(off["marker_error_y"], np.hypot(6.0, 0.01) - 6.0, atol=1e-9)
    T_other = se3.make(se3.exp_so3([0.3, -1.0, 2.0]), [5.0, 6.0, 7.0])
    moved = values(marker_metrics(markers(T_true), ids, T_other @ T_est))
    assert_allclose(list(moved.values()), list(off.values()), atol=1e-9)

    without = values(marker_metrics(markers(T_true), ids[:2], T_est[:2]))
    assert np.isnan(without["marker_error_y"])  # far_y's frames are not in the run
    assert_allclose(without["marker_error_x"], 0.0, atol=1e-9)
    assert marker_metrics((), ids, T_est) == []
    assert list(values(marker_metrics(markers(T_true)[:2], ids, T_est))) == ["marker_error_x"]


SCENE = """
<mujoco model="steps">
  <worldbody>
    <geom name="floor" type="box" size="2 2 0.1" pos="0 0 -0.1"/>
    <geom name="step" type="box" size="0.2 0.2 0.05" pos="0.3 0.1 0.05"/>
    <geom name="marker_origin" type="cylinder" size="0.08 0.001" pos="0 0 0.001"/>
    <geom name="marker_far_x" type="cylinder" size="0.08 0.001" pos="0.3 0.1 0.101"/>
    <body name="arm" pos="0 0 0.5">
      <joint name="turns" type="hinge" axis="0 0 1"/>
      <geom name="link" type="box" size="0.05 1 0.05"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def stepped(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A few small frames of a floor with a step and two markers, without an arm over it."""
    folder = tmp_path_factory.mktemp("steps")
    (folder / "steps.xml").write_text(SCENE[: SCENE.index("<body")] + "</worldbody></mujoco>")
    options = sim.GenerateOptions(seed=1, size=(160, 120), frames=4, clean=True)
    return Dataset.open(sim.generate(str(folder / "steps.xml"), folder / "set", options))


def test_rays_find_the_true_surface_and_no_arm(tmp_path: Path, stepped: Dataset) -> None:
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "scene.xml").write_text(SCENE)
    surface = TrueSurface(tmp_path)
    T_true_map = se3.make(se3.exp_so3([0, 0, np.pi / 2]), [0.3, -0.55, 2.0])
    z = surface.heights(T_true_map, (0.0, -0.005), 0.01, (1, 300))
    # along world y at x = 0.305: floor, step from -0.1 to 0.3, marker, floor, nothing beyond 2
    y = -0.55 + 0.01 * np.arange(300)
    expected = np.where(np.abs(y - 0.1) < 0.2, 0.1, 0.0)
    expected = np.where(np.abs(y - 0.1) < 0.08, 0.102, expected) - 2.0
    expected[y > 2.0] = np.nan
    clear = np.min(np.abs(y[:, None] - [-0.1, 0.3, 2.0, 0.02, 0.18]), axis=1) > 5e-3
    assert_allclose(z[0][clear], expected[clear], atol=1e-6)
    assert TrueSurface.of(stepped) is not None


def made_run(path: Path, data: Dataset, result: Result, T: Floats, lift: float) -> Path:
    """A run with given poses whose map is the true one, lifted."""
    n, origin, spacing, shape = len(data), (-0.507, -0.507), 0.02, (51, 51)
    surface = TrueSurface.of(data)
    assert surface is not None
    heights = surface.heights(np.eye(4), origin, spacing, shape) + lift
    there = DepthMap(
        heights, origin, spacing, np.eye(4), np.ones(shape, np.int64), np.full(shape, 1e-3)
    )
    made = replace(
        result,
        frame_ids=data.ids,
        stamps=tuple(float(s) for s in data.stamps),
        T_world_camera=T,
        T_world_camera_start=T,
        depth_map=there,
        depth_map_start=replace(there, heights=heights + 0.1),
        covariance=np.zeros((6 * n, 6 * n)),
        history=(),
    )
    folder = RunFolder.create(path)
    folder.write(made, Options(), data)
    return folder.path


def test_evaluate_judges_map_and_markers(tmp_path: Path, stepped: Dataset, result: Result) -> None:
    """The true map 2 mm up; poses and map in another world, where frame 0 says how it lies."""
    T_true = stepped.T_world_camera_true
    assert T_true is not None
    run = made_run(tmp_path / "run", stepped, result, T_true, 2e-3)
    judged = judge(run)
    got, before = values(list(judged.metrics)), values(list(judged.start_metrics))
    assert_allclose([got["map_rmse"], got["map_p95"]], 2e-3, atol=2e-5)
    assert_allclose(before["map_rmse"], 0.102, atol=2e-5)
    assert got["map_complete_1x"] == 1.0 and before["map_complete_5x"] == 0.0
    assert got["cloud_to_cloud"] <= 2e-3 + 1e-9 and got["chamfer"] < 4e-3 + 1e-9
    assert got["marker_error_x"] < 1e-3 and "marker_error_y" not in got
    page = report(judged)
    assert "Map against true surface" in page and "Distance of markers along X" in page

    lean = T_true.copy()
    lean[0, 2, 3] += 2e-3  # frame 0 carries the map down with it
    sunk = values(list(judge(made_run(tmp_path / "sunk", stepped, result, lean, 2e-3)).metrics))
    assert sunk["map_rmse"] < 1e-5

    bare = tmp_path / "bare"
    shutil.copytree(stepped.path, bare, ignore=shutil.ignore_patterns("scene", "markers.json"))
    plain = values(list(judge(run, dataset=bare).metrics))
    assert not {n for n in plain if n.startswith(("map_", "marker_", "chamfer"))}
    assert np.isfinite(plain["mean_map_entropy"]) and len(load_clouds(stepped)) == 4
