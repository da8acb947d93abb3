"""Clouds as Open3D, pye57 and laspy write them; and theirs read of ours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from depthba import se3
from depthba.convert import Reading, importing
from depthba.convert.clouds import cloud_files
from depthba.errors import DatasetError

POINTS = np.random.default_rng(1).normal(size=(2000, 3)).astype(np.float32).astype(np.float64)
POINTS[500:1500] = POINTS[0]  # repeats, which compression refers back to
COLOURS = np.random.default_rng(2).integers(0, 256, (2000, 3), dtype=np.uint8)


def test_open3d_and_ours_read_each_other(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    for name, options in {
        "binary.ply": {},
        "text.ply": {"write_ascii": True},
        "binary.pcd": {},
        "text.pcd": {"write_ascii": True},
        "packed.pcd": {"compressed": True},
        "some.xyz": {},
    }.items():
        assert o3d.io.write_point_cloud(str(tmp_path / name), cloud, **options)
        loose = 1e-4 if "text" in name else 1e-6
        assert_allclose(cloud_files.read(tmp_path / name), POINTS, rtol=0, atol=loose)
    for suffix in (".ply", ".pcd", ".xyz"):
        file = tmp_path / f"ours{suffix}"
        cloud_files.write(file, POINTS, None if suffix == ".xyz" else COLOURS)
        back = o3d.io.read_point_cloud(str(file))
        assert_allclose(np.asarray(back.points), POINTS, rtol=0, atol=1e-7)
        if suffix != ".xyz":
            assert_array_equal(np.rint(255 * np.asarray(back.colors)), COLOURS)


def test_e57_as_its_library_writes_it(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    T = se3.make(se3.exp_so3([[0.2, 0.1, 1.0], [-0.4, 2.0, 0.3]]), [[1.0, 2, 3], [-4.0, 5, 6]])
    with pye57.E57(str(tmp_path / "scans.e57"), mode="w") as file:
        for pose in T:
            x, y, z, w = se3.quaternion(pose)
            data = {f"cartesian{a}": POINTS[:, k].copy() for k, a in enumerate("XYZ")}
            file.write_scan_raw(data, rotation=np.array([w, x, y, z]), translation=pose[:3, 3])
    recording = importing.read(tmp_path / "scans.e57", Reading(unchecked=True))
    assert_allclose(recording.T_world_camera, T, rtol=0, atol=1e-9)
    with pye57.E57(str(tmp_path / "scans.e57")) as file:
        world = file.read_scan(1, ignore_missing_fields=True)  # its own idea of where they lie
    cloud = recording.frames[1].cloud
    assert cloud is not None
    ours = cloud() @ T[1, :3, :3].T + T[1, :3, 3]
    assert_allclose(ours, np.stack([world[f"cartesian{a}"] for a in "XYZ"], 1), atol=1e-6)


def test_las_in_a_national_grid_keeps_its_millimetres(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    far = np.array([456_789.0, 5_432_100.0, 310.0])
    for k in range(3):
        header = laspy.LasHeader(point_format=3, version="1.4")
        header.scales, header.offsets = np.full(3, 1e-4), far
        tile = laspy.LasData(header)
        tile.xyz = POINTS + far
        tile.write(tmp_path / f"tile-{k}.laz")
    with pytest.raises(DatasetError, match="or --poses identity where the clouds lie in one frame"):
        importing.read(tmp_path, Reading())
    recording = importing.read(tmp_path, Reading(poses="identity", unchecked=True))
    assert not recording.origin
    dataset = importing.into_dataset(recording, tmp_path / "out", Reading()).dataset
    T = dataset.T_world_camera_measured[1]
    assert_allclose(dataset[1].points() + T[:3, 3], POINTS + far, rtol=0, atol=6e-5)


@pytest.mark.parametrize(
    ("name", "data", "told"),
    [
        ("a.ply", b"nonsense\n", "a.ply: begins with b'nonsense', expected a PLY file"),
        ("a.pcd", b"nonsense\n", "a.pcd: begins with 'nonsense', expected a PCD file"),
        ("a.pcd", b"VERSION 0.7\nFIELDS x y z\nDATA binary\n", "a.pcd: PCD header is not whole"),
        ("a.xyz", b"1 2\n", "a.xyz: line 1: 2 numbers, expected"),
        ("a.las", b"nonsense" * 100, "a.las: .*, expected a LAS or LAZ file"),
    ],
)
def test_a_broken_cloud_is_named(name: str, data: bytes, told: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(DatasetError, match=told):
        cloud_files.read(tmp_path / name)
