"""Depth in steps that leave little of it is refused; what a camera gives is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from depthba.convert import Reading, importing
from depthba.errors import DatasetError
from depthba.trajectory import write_tum
from tests.depthba.convert import small_scene

METRES = Reading(intrinsics=small_scene.LENS, depth_scale=1.0)
WRONG = replace(METRES, depth_scale=0.001)


def floats(path: Path, size: float = 1.0) -> Path:
    """Write a folder of .npy in metres, the scene larger by a factor."""
    path.mkdir()
    T = small_scene.poses()
    for k, pose in enumerate(T):
        depth = np.nan_to_num(size * small_scene.depth(pose)).astype(np.float32)
        np.save(path / f"{k:03d}.npy", depth)
    T[:, :3, 3] *= size
    write_tum(path / "poses.txt", np.arange(6.0), T)
    return path


def whole(path: Path, size: float) -> Path:
    """Write a folder of 16-bit images of whole metres."""
    for k, pose in enumerate(small_scene.poses()):
        pixels = np.nan_to_num(np.rint(size * small_scene.depth(pose))).astype(np.uint16)
        small_scene.write_png(path / f"{k:03d}.png", pixels)
    write_tum(path / "poses.txt", np.arange(6.0), small_scene.poses())
    return path


def test_depth_in_floats_of_metres_is_to_be_read_as_such(tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        importing.read(floats(tmp_path / "set"), WRONG)
    told = "expected --depth-scale 1 (points 1.03 m away), or --pose-scale 0.001 (points 0.00103 m "
    assert told in str(caught.value)


def test_poses_in_units_that_agree_with_them_do_not_make_it_millimetres(tmp_path: Path) -> None:
    """Frames overlap then, and would be kept as a dozen values."""
    path = floats(tmp_path / "set")
    reading = replace(WRONG, pose_scale=0.001)
    recording = importing.read(path, reading)
    told = (
        r"set: depth of typically 0.00\d+ m would be kept in steps of 0.0001 m, expected 50 steps "
        r"or more: is --depth-scale right\? or --unchecked"
    )
    with pytest.raises(DatasetError, match=told):
        importing.into_dataset(recording, tmp_path / "out", reading)
    assert not (tmp_path / "out").exists()
    importing.into_dataset(recording, tmp_path / "out", replace(reading, unchecked=True))
    importing.into_dataset(importing.read(path, METRES), tmp_path / "right", METRES)


@pytest.mark.parametrize("size", [0.1, 20.0])
def test_what_cameras_see_from_near_and_far_is_kept(size: float, tmp_path: Path) -> None:
    """10 cm is nearer than depth cameras of whole millimetres see."""
    path = floats(tmp_path / "set", size)
    importing.into_dataset(importing.read(path, METRES), tmp_path / "out", METRES)


def test_whole_millimetres_of_a_near_scene_are_kept(tmp_path: Path) -> None:
    path = whole(tmp_path / "set", 100.0)
    reading = replace(WRONG, pose_scale=0.1)
    importing.into_dataset(importing.read(path, reading), tmp_path / "out", reading)


@pytest.mark.parametrize("scale", [1.0, 0.001])
@pytest.mark.parametrize(
    ("size", "held"), [(0.8, "only the value 1"), (20.0, r"whole numbers, 1\d to 2\d, half of")]
)
def test_metres_rounded_to_whole_numbers_are_named(
    scale: float, size: float, held: str, tmp_path: Path
) -> None:
    path, reading = whole(tmp_path / "set", size), replace(METRES, depth_scale=scale)
    told = (
        f"set: depth images hold {held}.*: were metres rounded to whole numbers\\? expected "
        "millimetres or a finer step, or --unchecked"
    )
    with pytest.raises(DatasetError, match=told):
        importing.read(path, reading)
    importing.read(path, replace(reading, unchecked=True))
