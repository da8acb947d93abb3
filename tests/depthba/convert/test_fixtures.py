"""Sources as others make them: by the formats' own libraries, or by their public descriptions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from depthba import se3
from depthba.convert import Reading, importing
from depthba.errors import DatasetError
from tests.depthba.convert import small_scene
from tests.depthba.convert.small_scene import LENS, millimetres, poses, write_png

RAW = Reading(unchecked=True)


def flat(path: Path, value: int, size: tuple[int, int] = (480, 640)) -> None:
    """Write depth of one value, of the size that a format's published intrinsics are for."""
    write_png(path, np.full(size, value, np.uint16))


def test_tum_rgbd_by_its_description(tmp_path: Path) -> None:
    path = tmp_path / "rgbd_dataset_freiburg3_desk"
    for stamp in ("10.02", "10.07", "12.00"):
        flat(path / "depth" / f"{stamp}.png", 5000)
        write_png(path / "rgb" / f"{stamp}.png", np.full((480, 640, 3), 7, np.uint8))
    lines = "# depth maps\n# timestamp filename\n"
    names = ("10.02", "10.07", "12.00")
    (path / "depth.txt").write_text(lines + "".join(f"{s} depth/{s}.png\n" for s in names))
    (path / "rgb.txt").write_text("10.025 rgb/10.02.png\n10.5 rgb/10.07.png\n")
    half = np.sqrt(0.5)
    (path / "groundtruth.txt").write_text(
        "# ground truth trajectory\n10.00 0 0 0 0 0 0 1\n10.04 0.4 0 2 0 0 0 1\n"
        f"10.10 1.0 0 2 0 0 {half:.4f} {half:.4f}\n"
    )
    recording = importing.read(path, RAW)
    assert [frame.stamp for frame in recording.frames] == [10.02, 10.07]
    assert_allclose(recording.T_world_camera[0][:3, 3], [0.2, 0, 1], atol=1e-12)
    # half way through a quarter turn, and of the way
    assert_allclose(recording.T_world_camera[1][:3, 3], [0.7, 0, 2], atol=1e-12)
    assert_allclose(se3.log_so3(recording.T_world_camera[1][:3, :3]), [0, 0, np.pi / 4], atol=1e-9)
    frame = recording.frames[0]
    assert frame.depth is not None and frame.camera is not None and frame.rgb is not None
    assert_allclose(frame.depth(), 1.0)
    assert (frame.camera.fx, frame.camera.cy) == (535.4, 247.6)
    assert recording.frames[1].rgb is None  # the nearest is 0.43 s off
    assert "1 frame left out" in recording.notes[0] and "12.00.png" in recording.notes[0]
    unknown = path.rename(tmp_path / "desk")
    with pytest.raises(DatasetError, match="nor is freiburg1, 2 or 3 in its name, expected --intr"):
        importing.read(unknown, RAW)


def test_seven_scenes_by_its_description(tmp_path: Path) -> None:
    path = tmp_path / "chess" / "seq-01"
    path.mkdir(parents=True)
    for k in range(2):
        flat(path / f"frame-{k:06d}.depth.png", 65535 if k else 1500)
        write_png(path / f"frame-{k:06d}.color.png", np.zeros((480, 640, 3), np.uint8))
        rows = "\t ".join(["1.0000000e+000", "0", "0", f"{k}.5000000e-001"])
        (path / f"frame-{k:06d}.pose.txt").write_text(
            f"{rows}\t \n0 1 0 0\t \n0 0 1 0\t \n0 0 0 1\t \n"
        )
    recording = importing.read(tmp_path / "chess", RAW)
    assert recording.format == "7-scenes"
    assert_allclose(recording.T_world_camera[:, 0, 3], [0.05, 0.15])
    first, second = recording.frames
    assert first.depth is not None and second.depth is not None and first.camera is not None
    assert_allclose(first.depth(), 1.5)
    assert np.isnan(second.depth()).all()
    assert first.camera.fx == 585.0 and first.rgb is None
    assert any("not aligned to depth" in note for note in recording.notes)


def test_redwood_as_open3d_writes_it(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    parameters = []
    for T in poses():
        one = o3d.camera.PinholeCameraParameters()
        one.extrinsic = np.linalg.inv(T)
        one.intrinsic = o3d.camera.PinholeCameraIntrinsic(80, 60, *LENS)
        parameters.append(one)
        write_png(tmp_path / "depth" / f"{len(parameters):05d}.png", millimetres(T))
    trajectory = o3d.camera.PinholeCameraTrajectory()
    trajectory.parameters = parameters
    assert o3d.io.write_pinhole_camera_trajectory(str(tmp_path / "odometry.log"), trajectory)
    assert o3d.io.write_pinhole_camera_intrinsic(
        str(tmp_path / "camera_intrinsic.json"), parameters[0].intrinsic
    )
    recording = importing.read(tmp_path, Reading())
    assert recording.format == "redwood"
    assert_allclose(recording.T_world_camera, poses(), rtol=0, atol=1e-7)  # it writes 8 decimals
    assert recording.frames[0].camera is not None
    assert (
        recording.frames[0].camera.matrix.tolist()
        == parameters[0].intrinsic.intrinsic_matrix.tolist()
    )


def test_nerfstudio_by_its_description(tmp_path: Path) -> None:
    frames = []
    for k, T in enumerate(poses()):
        write_png(tmp_path / "depths" / f"{k}.png", millimetres(T))
        matrix = (T @ np.diag([1, -1, -1, 1])).tolist()
        frames.append(
            {"file_path": f"images/{k}.png", "depth_file_path": f"depths/{k}.png"}
            | {"transform_matrix": matrix}
        )
    lens = {"fl_x": 80.0, "fl_y": 80.0, "cx": 40.0, "cy": 30.0, "w": 80, "h": 60}
    head = {"camera_model": "OPENCV", **lens, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    (tmp_path / "transforms.json").write_text(json.dumps({**head, "frames": frames}))
    recording = importing.read(tmp_path, Reading())
    assert_allclose(recording.T_world_camera, poses(), rtol=0, atol=1e-12)
    camera = recording.frames[0].camera
    assert camera is not None
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == LENS  # centres at integers here
    frames[0]["fl_x"] = 81.0
    (tmp_path / "transforms.json").write_text(json.dumps({**head, "frames": frames}))
    mixed = importing.into_dataset(importing.read(tmp_path, Reading()), tmp_path / "out", Reading())
    assert mixed.dataset.sensor.kind == "cloud"
    assert any("2 different intrinsics" in note for note in mixed.notes)


def test_bop_by_its_description(tmp_path: Path) -> None:
    scene = {}
    for k, T in enumerate(poses()):
        # the pixel times depth_scale is mm: here each step is 0.1 mm
        write_png(tmp_path / "depth" / f"{k + 3:06d}.png", millimetres(T, 1e-4))
        T_camera_world = np.linalg.inv(T)
        scene[str(k + 3)] = {
            "cam_K": [80.0, 0.0, 39.5, 0.0, 80.0, 29.5, 0.0, 0.0, 1.0],
            "depth_scale": 0.1,
            "cam_R_w2c": T_camera_world[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000 * T_camera_world[:3, 3]).tolist(),
        }
    (tmp_path / "scene_camera.json").write_text(json.dumps(scene))
    recording = importing.read(tmp_path, Reading())
    assert_allclose(recording.T_world_camera, poses(), rtol=0, atol=1e-12)
    assert recording.depth_scale == pytest.approx(1e-4)
    depth = recording.frames[2].depth
    assert depth is not None
    assert_allclose(depth(), small_scene.depth(poses()[2]), atol=1e-9)
    del scene["4"]["cam_t_w2c"]
    (tmp_path / "scene_camera.json").write_text(json.dumps(scene))
    with pytest.raises(DatasetError, match="image 4: cam_t_w2c is missing or not 3 numbers"):
        importing.read(tmp_path, Reading())


def test_scannet_leaves_out_where_tracking_was_lost(tmp_path: Path) -> None:
    for k, T in enumerate(poses()):
        write_png(tmp_path / "depth" / f"{k}.png", millimetres(T))
        write_png(tmp_path / "color" / f"{k}.jpg", np.zeros((120, 160, 3), np.uint8))
        (tmp_path / "pose").mkdir(exist_ok=True)
        rows = np.full((4, 4), -np.inf) if k == 1 else T
        np.savetxt(tmp_path / "pose" / f"{k}.txt", rows)
    (tmp_path / "intrinsic").mkdir()
    K = np.array([[80.0, 0, 39.5, 0], [0, 80, 29.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_depth.txt", K)
    recording = importing.read(tmp_path, Reading())
    assert [frame.name for frame in recording.frames] == [f"{k}.png" for k in (0, 2, 3, 4, 5)]
    assert "1.txt" in recording.notes[0]
    assert "5 colour images left out" in recording.notes[1]


def test_kitti_by_its_description(tmp_path: Path, cloud_set: object) -> None:
    """The poses are the camera's, the clouds the laser scanner's, which looks along x."""
    T_camera_laser = np.array([[0, -1.0, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
    clouds = [frame.points() for frame in cloud_set]  # type: ignore[attr-defined]
    (tmp_path / "velodyne").mkdir()
    for k, points in enumerate(clouds):
        p = (points - T_camera_laser[:3, 3]) @ T_camera_laser[:3, :3]
        rows = np.column_stack([p, np.full(len(p), 0.5)]).astype(np.float32)
        rows.tofile(tmp_path / "velodyne" / f"{k:06d}.bin")
    np.savetxt(tmp_path / "poses.txt", poses()[:, :3].reshape(-1, 12), fmt="%.6e")
    np.savetxt(tmp_path / "times.txt", 0.1 * np.arange(6), fmt="%.6e")
    tr = " ".join(f"{v:.12e}" for v in T_camera_laser[:3].ravel())
    (tmp_path / "calib.txt").write_text(f"P0: {' '.join(['1'] * 12)}\nTr: {tr}\n")
    recording = importing.read(tmp_path, Reading())
    assert recording.format == "kitti"
    for k, frame in enumerate(recording.frames):
        assert frame.cloud is not None
        T = recording.T_world_camera[k]
        world = frame.cloud() @ T[:3, :3].T + T[:3, 3]
        want = clouds[k] @ poses()[k][:3, :3].T + poses()[k][:3, 3]
        assert_allclose(world, want, atol=5e-6)
    (tmp_path / "velodyne" / "000002.bin").write_bytes(b"\0" * 17)
    with pytest.raises(DatasetError, match=r"000002.bin: 17 bytes, expected 16 a point"):
        importing.into_dataset(recording, tmp_path / "out", Reading())


def test_zed_export(tmp_path: Path) -> None:
    for k, T in enumerate(poses()):
        write_png(tmp_path / f"depth{k:06d}.png", millimetres(T))
        write_png(tmp_path / f"left{k:06d}.png", small_scene.colour(k))
    np.savetxt(tmp_path / "poses.txt", poses()[:, :3].reshape(-1, 12), fmt="%.17g")
    recording = importing.read(tmp_path, Reading(intrinsics=LENS))
    assert recording.format == "zed"
    assert_allclose(recording.T_world_camera, poses(), atol=1e-9)
    rgb = recording.frames[3].rgb
    assert rgb is not None and (rgb() == small_scene.colour(3)).all()


def test_two_formats_in_one_folder_are_not_guessed_at(tmp_path: Path) -> None:
    (tmp_path / "scene_camera.json").write_text("{}")
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(DatasetError, match=r"could be nerfstudio \(.*\) or bop \(.*--kind$"):
        importing.read(tmp_path, RAW)
    with pytest.raises(DatasetError, match=r"transforms.json: no frames in it"):
        importing.read(tmp_path, Reading(kind="nerfstudio"))
    with pytest.raises(
        DatasetError, match=r"nothing in it is known \(.*\), expected a dataset or one of"
    ):
        importing.read(Path(__file__).parent, RAW)
