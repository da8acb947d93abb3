"""From a bare folder to a run, and from the run into other people's tools."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose, assert_array_equal

from depthba import cli, se3
from depthba.dataset import Dataset, verify
from depthba.stored_run import Run
from depthba.trajectory import write_tum
from tests.depthba.convert import small_scene

LENS = [str(v) for v in small_scene.LENS]


def depthba(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "depthba", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Depth in mm in PNGs named by their stamps, and a TUM file: twelve frames."""
    path = tmp_path_factory.mktemp("bare") / "frames"
    T = small_scene.poses(12)
    for k, pose in enumerate(T):
        small_scene.write_png(path / f"{1000 + k}.250000.png", small_scene.millimetres(pose))
    off = T.copy()
    off[1:, :3, 3] += np.random.default_rng(0).normal(0, 0.004, (11, 3))
    write_tum(path / "trajectory.txt", 1000.25 + np.arange(12.0), off)
    return path


@pytest.fixture(scope="module")
def run(bare: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Register the folder directly: every other frame, masked, between two depths."""
    out = tmp_path_factory.mktemp("run")
    mask = np.full((60, 80), 255, np.uint8)
    mask[:, :8] = 0
    assert cv2.imwrite(str(out / "mask.png"), mask)
    done = depthba(
        "register", bare, "--out", out / "run", "--intrinsics", *LENS, "--depth-scale", 0.001,
        "--map-frame", "world", "--every", 2, "--mask", out / "mask.png", "--depth-range", 0.5, 1.3,
        "--resolution", 0.03, "--json",
    )  # fmt: skip
    assert done.returncode in (0, 3), done.stderr
    assert json.loads(done.stdout)["frames"] == 6
    assert "frames agree in" in done.stderr
    return out / "run"


def test_register_takes_a_bare_folder(run: Path) -> None:
    inner = Dataset.open(run / "dataset")
    assert verify(inner.path) == []
    assert_allclose(inner.stamps, 1000.25 + 2 * np.arange(6))
    opened = Run.open(run)
    assert opened.dataset_path == inner.path.resolve()
    saved = yaml.safe_load((run / "config.yaml").read_text())
    assert saved["depth_range"] == [0.5, 1.3] and saved["mask"].endswith("mask.png")
    truth = small_scene.poses(12)[::2]
    error = se3.difference(se3.align_first(opened.T_world_camera, truth), truth)
    start = se3.difference(se3.align_first(inner.T_world_camera_measured, truth), truth)
    assert np.abs(error[:, :3]).mean() < 0.5 * np.abs(start[:, :3]).mean()


def test_evo_reads_the_poses(run: Path, tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    opened = Run.open(run)
    for name in ("poses.tum", "poses.kitti"):
        assert cli.main(["convert", str(run), str(tmp_path / name)]) == 0
    tum = file_interface.read_tum_trajectory_file(tmp_path / "poses.tum")
    kitti = file_interface.read_kitti_poses_file(tmp_path / "poses.kitti")
    for read in (tum, kitti):
        assert_allclose(np.array(read.poses_se3), opened.T_world_camera, rtol=0, atol=1e-9)
    assert_allclose(tum.timestamps, opened.stamps, rtol=0, atol=1e-9)


def test_gtsam_reads_the_graph(run: Path, tmp_path: Path) -> None:
    gtsam = pytest.importorskip("gtsam")
    assert cli.main(["convert", str(run), str(tmp_path / "poses.g2o")]) == 0
    graph, values = gtsam.readG2o(str(tmp_path / "poses.g2o"), True)
    opened = Run.open(run)
    for k, T in enumerate(opened.T_world_camera):
        assert_allclose(values.atPose3(k).matrix(), T, rtol=0, atol=1e-9)
    assert graph.size() == len(opened.T_world_camera) - 1
    assert graph.error(values) < 1e-12


def test_edges_have_the_information_that_the_covariance_says() -> None:
    """By differences: samples of the poses, and what g2o's error makes of them."""
    from depthba.convert.results.trajectories import edge_information

    random = np.random.default_rng(4)
    T = small_scene.poses(3)
    A = 1e-4 * random.normal(size=(18, 18))
    S = A @ A.T
    moved = random.multivariate_normal(np.zeros(18), S, 40_000).reshape(-1, 3, 6)
    poses = se3.retract(T[None], moved)
    delta = se3.inverse(se3.inverse(T[1]) @ T[2]) @ se3.inverse(poses[:, 1]) @ poses[:, 2]
    e = np.concatenate([delta[:, :3, 3], se3.quaternion(delta)[:, :3]], axis=1)
    found = np.cov(e.T)
    want = np.linalg.inv(edge_information(T, S, 1, 2))
    scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
    assert np.abs((found - want) / scale).max() < 0.03


def test_clouds_of_a_run(run: Path, tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    laspy = pytest.importorskip("laspy")
    for name in ("cloud.ply", "cloud.pcd", "cloud.laz"):
        assert cli.main(["convert", str(run), str(tmp_path / name)]) == 0
    want = o3d.io.read_point_cloud(str(run / "cloud.ply"))
    for name in ("cloud.ply", "cloud.pcd"):
        found = o3d.io.read_point_cloud(str(tmp_path / name))
        assert_array_equal(np.asarray(found.points), np.asarray(want.points))
        assert_allclose(np.asarray(found.colors), np.asarray(want.colors), atol=1e-9)
    las = laspy.read(tmp_path / "cloud.laz")
    assert_allclose(las.xyz, np.asarray(want.points), rtol=0, atol=0.51e-5)
    assert_array_equal(np.asarray(las.red) // 257, np.rint(255 * np.asarray(want.colors)[:, 0]))


def test_a_geotiff_reader_finds_the_heights_where_they_are(run: Path, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    for name in ("map.tif", "map.png"):
        assert cli.main(["convert", str(run), str(tmp_path / name)]) == 0
    depth_map = Run.open(run).depth_map
    seen = np.argwhere(np.isfinite(depth_map.heights))[::37]
    x = depth_map.origin[0] + depth_map.spacing * seen[:, 1]
    y = depth_map.origin[1] + depth_map.spacing * seen[:, 0]
    want = depth_map.heights[tuple(seen.T)]
    with rasterio.open(tmp_path / "map.tif") as raster:
        assert raster.crs is None or raster.crs.linear_units in ("metre", "unknown", "m")
        assert_allclose([v[0] for v in raster.sample(np.c_[x, y])], want, rtol=0, atol=1e-6)
        unseen = np.flipud(np.isnan(depth_map.heights))
        assert_array_equal(raster.read(1, masked=True).mask, unseen)
    picture = cv2.imread(str(tmp_path / "map.png"), cv2.IMREAD_UNCHANGED)
    said = json.loads((tmp_path / "map.json").read_text())
    left, top = said["upper_left_m"]
    row = np.rint((top - y) / said["spacing_m"]).astype(int)
    column = np.rint((x - left) / said["spacing_m"]).astype(int)
    heights = said["offset_m"] + said["scale_m"] * picture[row, column]
    assert_allclose(heights, want, rtol=0, atol=0.51 * said["scale_m"])
    assert_array_equal(picture == 0, unseen)


def test_the_mesh_is_the_map(run: Path, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    assert cli.main(["convert", str(run), str(tmp_path / "map.glb")]) == 0
    assert cli.main(["convert", str(run), str(tmp_path / "map.ply"), "--to", "mesh"]) == 0
    vertices = Run.open(run).depth_map.vertices()
    vertices = vertices[np.isfinite(vertices).all(axis=-1)]
    mesh = trimesh.load(str(tmp_path / "map.ply"), process=False)
    assert_allclose(mesh.vertices, vertices, atol=1e-6)
    assert (mesh.face_normals[:, 2] > 0).all()
    up = trimesh.load(str(tmp_path / "map.glb"), process=False).to_geometry()
    assert_allclose(np.sort(up.vertices[:, 1]), np.sort(vertices[:, 2]), atol=1e-6)
    assert len(up.faces) == len(mesh.faces) > 100


def test_a_run_becomes_a_dataset_of_another_format_at_its_poses(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["convert", str(run), str(tmp_path / "transforms.json")]) == 0
    back = tmp_path / "back"
    # its images lie where they lay: to read them again is to be asked for
    assert cli.main(["convert", str(tmp_path / "transforms.json"), str(back)]) == 1
    assert "leads out of" in capsys.readouterr().err
    assert cli.main(["convert", str(tmp_path / "transforms.json"), str(back), "--outside"]) == 0
    dataset, opened = Dataset.open(back), Run.open(run)
    assert_allclose(dataset.T_world_camera_measured, opened.T_world_camera, rtol=0, atol=1e-9)
    assert_array_equal(dataset[3].depth(), Dataset.open(run / "dataset")[3].depth())


def test_convert_cuts_merges_and_says_what_it_did(
    bare: Path, depth_set: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--every", "5", "--height-range", "-0.02", "0.01", "--merge", str(bare), "--json"]
    words += ["--intrinsics", *LENS, "--depth-scale", "0.001"]
    assert cli.main(["convert", str(depth_set.path), str(tmp_path / "out"), *words]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["frames"] == 2 + 3
    merged = Dataset.open(tmp_path / "out")
    frame = depth_set.crop(heights=(-0.02, 0.01))[5]
    assert_array_equal(merged[1].depth(), frame.depth())
    assert [p.name for p in tmp_path.iterdir()] == ["out"]  # nothing of what was in between


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["{bare}", "{new}"], "expected --depth-scale METRES"),
        (["{gone}", "{new}"], "gone: no such file or folder"),
        (["{set}", "{new}.xls"], "new.xls: suffix '.xls', expected one of"),
        (["{set}", "{new}", "--to", "zed"], "--to zed: is not written; choose from: depthba, tum"),
        (["{set}", "{bare}"], "is in the way, expected a new or empty folder"),
        (["{set}", "{bare}/trajectory.txt"], "is there already, expected a new file, or --overwri"),
        (["{set}", "{new}.tif"], "has no depth map, expected a run folder"),
        (
            ["{set}", "{new}", "--to", "tum-rgbd", "--poses", "best"],
            "no poses 'best', expected one",
        ),
        (["{set}", "{new}", "--poses", "true"], "goes with --to another format alone"),
        (["{set}", "{new}", "--axes", "opengl"], "a dataset says by itself how it is meant"),
        (["{bare}", "{new}", "--kind", "colmap"], "--kind colmap: is written only, not read"),
        (["{bare}", "{new}", "--kind", "tum-rgbd"], "depth.txt: no such file"),
    ],
)
def test_errors_are_one_line_and_leave_nothing(
    words: list[str],
    told: str,
    bare: Path,
    depth_set: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    places = {"bare": bare, "set": depth_set.path, "new": tmp_path / "new", "gone": bare / "gone"}
    assert cli.main(["convert", *(word.format(**places) for word in words)]) == 1
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_run_is_no_source(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["register", str(run), "--out", str(tmp_path / "out")]) == 1
    assert f"{run}: a run of depthba, expected a dataset" in capsys.readouterr().err
    assert cli.main(["convert", str(run), str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert f"{run}: a run, expected a dataset; or say what" in told and "--to colmap" in told
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_takes_no_options_of_reading(
    depth_set: Dataset, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["register", str(depth_set.path), "--out", str(tmp_path / "r"), "--axes", "opengl"]
    assert cli.main(words) == 1
    assert "a dataset says by itself how it is meant" in capsys.readouterr().err
    assert cli.main(["convert", "--list"]) == 0
    assert "nerfstudio" in capsys.readouterr().out
