"""Out and back: poses to 1e-9, depth to the quantisation of the format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from depthba.convert import Reading, exporting, importing
from depthba.convert.results.outcome import Outcome
from depthba.dataset import Dataset, verify
from tests.depthba.convert import small_scene


def there_and_back(dataset: Dataset, to: str, folder: Path) -> importing.Imported:
    kind = exporting.target(folder / "out", to)
    assert kind is not None
    T = dataset.T_world_camera_measured
    exporting.write(Outcome.of_dataset(dataset, T), kind, folder / "out")
    recording = importing.read(folder / "out", Reading())
    return importing.into_dataset(recording, folder / "back", Reading())


@pytest.mark.parametrize(
    ("to", "step", "stamps"),
    [
        ("tum-rgbd", 1 / 5000, True),
        ("7-scenes", 0.001, False),
        ("redwood", 0.001, False),
        ("nerfstudio", 0.001, True),
        ("bop", 0.001, False),
        ("scannet", 0.001, False),
        ("kitti", 1 / 256, True),
    ],
)
def test_depth_formats_keep_poses_and_depth(
    to: str, step: float, stamps: bool, depth_set: Dataset, tmp_path: Path
) -> None:
    back = there_and_back(depth_set, to, tmp_path)
    assert back.format == to
    assert verify(back.dataset.path) == []
    assert len(back.dataset) == len(depth_set)
    assert_allclose(
        back.dataset.T_world_camera_measured, depth_set.T_world_camera_measured, rtol=0, atol=1e-9
    )
    if stamps:
        assert_allclose(back.dataset.stamps, depth_set.stamps, rtol=0, atol=1e-9)
    lens, want = back.dataset.sensor.camera, depth_set.sensor.camera
    assert lens is not None and want is not None
    assert_allclose([lens.fx, lens.fy, lens.cx, lens.cy], [want.fx, want.fy, want.cx, want.cy])
    assert back.dataset.sensor.depth_scale == pytest.approx(step, rel=1e-12)
    for ours, theirs in zip(depth_set, back.dataset, strict=True):
        z, found = ours.depth(), theirs.depth()
        assert_array_equal(np.isnan(z), np.isnan(found))
        # a step that the other divides is kept to the last digit
        exact = round(small_scene.STEP / step, 6).is_integer()
        assert_allclose(found, z, rtol=0, atol=1e-6 if exact else step / 2 + 1e-6)
        if to != "kitti":
            assert_array_equal(theirs.rgb(), ours.rgb())


@pytest.mark.parametrize("suffix", ["ply", "pcd", "xyz", "las", "laz", "e57"])
def test_cloud_formats_keep_poses_and_points(
    suffix: str, cloud_set: Dataset, tmp_path: Path
) -> None:
    pytest.importorskip({"las": "laspy", "laz": "laspy", "e57": "pye57"}.get(suffix, "numpy"))
    back = there_and_back(cloud_set, f"clouds-{suffix}", tmp_path)
    assert back.format == "clouds"
    assert_allclose(
        back.dataset.T_world_camera_measured, cloud_set.T_world_camera_measured, rtol=0, atol=1e-9
    )
    step = 0.5e-5 if suffix in ("las", "laz") else 0.0
    for ours, theirs in zip(cloud_set, back.dataset, strict=True):
        assert_allclose(theirs.points(), ours.points(), rtol=0, atol=step + 1e-7 * (step > 0))


def test_kitti_takes_clouds_too(cloud_set: Dataset, tmp_path: Path) -> None:
    back = there_and_back(cloud_set, "kitti", tmp_path)
    assert_allclose(
        back.dataset.T_world_camera_measured, cloud_set.T_world_camera_measured, rtol=0, atol=1e-9
    )
    assert_array_equal(back.dataset[2].points(), cloud_set[2].points())


def test_a_pcd_carries_its_pose(cloud_set: Dataset, tmp_path: Path) -> None:
    there_and_back(cloud_set, "clouds-pcd", tmp_path)
    (tmp_path / "out" / "poses.txt").unlink()
    recording = importing.read(tmp_path / "out", Reading(poses="viewpoint"))
    assert_allclose(recording.T_world_camera, cloud_set.T_world_camera_measured, rtol=0, atol=1e-9)


def test_colmap_reads_the_model(depth_set: Dataset, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    kind = exporting.target(tmp_path / "out", "colmap")
    assert kind is not None
    T = depth_set.T_world_camera_measured
    exporting.write(Outcome.of_dataset(depth_set, T), kind, tmp_path / "out")
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert model.num_images() == len(depth_set)
    for k, pose in enumerate(T):
        image = model.images[k + 1]
        T_camera_world = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        assert_allclose(np.linalg.inv(T_camera_world), pose, rtol=0, atol=1e-9)
        assert (tmp_path / "out" / "images" / image.name).is_file()
    # a point of the model, projected by COLMAP, falls where ours does, half a pixel further on
    point = next(iter(model.points3D.values())).xyz
    camera = depth_set.sensor.camera
    assert camera is not None
    p_camera = np.linalg.inv(T[0]) @ [*point, 1.0]
    seen = model.images[1].project_point(point)
    assert_allclose(seen - 0.5, camera.project(p_camera[None, :3])[0], atol=1e-6)
