"""Crop, mask, subsample, merge and save datasets from Python."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import depthba
from depthba import se3
from depthba.dataset import Dataset, DatasetWriter, Marker, verify
from depthba.errors import DatasetError, OptionError
from tests.depthba.convert import small_scene


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return small_scene.write_depth_set(tmp_path_factory.mktemp("data") / "set")


def world(dataset: Dataset) -> np.ndarray:
    T = dataset.T_world_camera_measured
    return np.concatenate(
        [f.points() @ T[k, :3, :3].T + T[k, :3, 3] for k, f in enumerate(dataset)]
    )


def test_a_crop_keeps_what_lies_inside_and_only_that(dataset: Dataset) -> None:
    roi = (-0.3, 0.2, -0.1, 0.25, -0.01, 0.02)
    everything, inside = world(dataset), world(dataset.crop(roi))
    keep = ((everything >= roi[0::2]) & (everything <= roi[1::2])).all(axis=1)
    assert 100 < len(inside) < len(everything)
    assert_allclose(inside, everything[keep], atol=1e-6)
    by_height = world(dataset.crop(heights=(0.0, 0.01)))
    assert_allclose(by_height, everything[(everything[:, 2] >= 0) & (everything[:, 2] <= 0.01)])
    near = dataset.crop(depths=(0.5, 0.95))
    z = near[2].depth()
    assert np.nanmax(z) <= 0.95 < np.nanmax(dataset[2].depth())
    assert_array_equal(np.isfinite(z), dataset[2].depth() <= 0.95)
    # cuts add up, and the dataset itself stays as it is
    assert len(world(near.crop(roi))) < min(len(world(near)), len(inside))
    assert len(world(dataset)) == len(everything)


def test_a_crop_in_a_map_frame_that_is_chosen(dataset: Dataset) -> None:
    tilted = se3.make(se3.exp_so3([0.9, -0.4, 0.3]), [5.0, -2.0, 1.0])
    moved = replace(
        dataset,
        map_frame="auto",
        frames=tuple(replace(f, T_world_camera=tilted @ f.T_world_camera) for f in dataset),
    )
    T_map_world = moved.T_map_world()
    assert not np.allclose(T_map_world[:3, :3], np.eye(3), atol=0.1)
    p = (
        world(moved.crop((-0.2, 0.2, -0.2, 0.2, -9, 9))) @ T_map_world[:3, :3].T
        + T_map_world[:3, 3]
    )
    assert len(p) and np.abs(p[:, :2]).max() <= 0.2 + 1e-6


def test_masks_out_of_arrays_files_and_folders(dataset: Dataset, tmp_path: Path) -> None:
    mask = np.zeros((60, 80), np.uint8)
    mask[20:40, 30:50] = 255
    cut = dataset.masked(mask)
    assert_array_equal(np.isfinite(cut[1].depth()), np.isfinite(dataset[1].depth()) & (mask > 0))
    assert cv2.imwrite(str(tmp_path / "mask.png"), mask)
    assert_array_equal(dataset.masked(tmp_path / "mask.png")[1].depth(), cut[1].depth())
    (tmp_path / "each").mkdir()
    for k, frame in enumerate(dataset):
        name = Path(frame.files["depth"].path).name
        assert cv2.imwrite(str(tmp_path / "each" / name), np.full((60, 80), k % 2, np.uint8))
    each = dataset.masked(tmp_path / "each")
    assert [bool(np.isfinite(frame.depth()).any()) for frame in each] == [False, True] * 3
    with pytest.raises(DatasetError, match=r"mask of shape \(80, 60\), expected"):
        dataset.masked(mask.T)
    with pytest.raises(DatasetError, match=r"gone.png: no such file"):
        dataset.masked(tmp_path / "gone.png")


def test_merged_sets_have_the_poses_truth_and_markers_of_both(
    dataset: Dataset, tmp_path: Path
) -> None:
    writer = DatasetWriter.create(tmp_path / "more", {**dataset.header, "name": "more"})
    for k in (5, 3):
        frame = dataset[k]
        writer.add_frame(
            stamp=float(8 - k),
            T_world_camera=frame.T_world_camera,
            T_world_camera_true=frame.T_world_camera,
            depth=frame.depth(),
            rgb=frame.rgb(),
        )
    writer.write_markers([Marker("a", np.zeros(3), ((1, np.array([0.0, 0, 1])),))])
    more = Dataset.open(tmp_path / "more")
    both = depthba.Dataset.merge([dataset.subsample(3), more, dataset])
    assert both.ids == tuple(range(10))
    assert both.name == "small+more"
    rows = [0, 3, 5, 3, 0, 1, 2, 3, 4, 5]
    T = dataset.T_world_camera_measured[rows]
    assert_allclose(both.T_world_camera_measured, T, atol=1e-12)
    assert both.T_world_camera_true is not None
    assert_allclose(both.T_world_camera_true, T, atol=1e-12)
    assert len(np.unique(np.rint(both.stamps * 1e6))) == 10  # those that met were shifted
    assert [m.observations[0][0] for m in both.markers()] == [3]
    assert_array_equal(both[2].depth(), dataset[5].depth())
    saved = both.crop(depths=(0.2, 0.95)).save(tmp_path / "saved")
    assert verify(saved.path) == []
    assert_allclose(saved.T_world_camera_measured, T, atol=1e-12)
    assert saved.map_frame == "world" and saved.seed == 3
    for k in range(10):
        z = dataset[rows[k]].depth()
        assert_array_equal(saved[k].depth(), np.where(z <= 0.95, z, np.nan).astype(np.float32))
        assert_array_equal(saved[k].rgb(), dataset[rows[k]].rgb())
    assert saved.markers()[0].observations[0][0] == 3


def test_what_makes_no_sense_is_refused(dataset: Dataset, tmp_path: Path) -> None:
    assert dataset.subsample(4).ids == (0, 4)
    with pytest.raises(OptionError, match="every is 0, expected 1 or more"):
        dataset.subsample(0)
    with pytest.raises(OptionError, match="depths: 2 is not below 1"):
        dataset.crop(depths=(2, 1))
    with pytest.raises(OptionError, match="roi: ymin 1 is not below ymax 0"):
        dataset.crop((0, 1, 1, 0, 0, 1))
    other = {**dataset.header, "sensor": {**dataset.header["sensor"], "fx": 81.0}}
    DatasetWriter.create(tmp_path / "other", other)
    with pytest.raises(DatasetError, match=r"sensor.fx is 81.0, expected 80.0 as in"):
        Dataset.merge([dataset, Dataset.open(tmp_path / "other")])
    clouds = small_scene.write_cloud_set(tmp_path / "clouds")
    with pytest.raises(DatasetError, match="holds clouds, but a mask is for depth images"):
        clouds.masked(np.ones((60, 80)))
    assert (clouds.crop(depths=(0.0, 0.9))[0].points()[:, 2] <= 0.9).all()
