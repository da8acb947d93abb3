"""A wrong convention destroys the overlap of the frames, and that is said."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from depthba.convert import Reading, importing, overlap
from depthba.convert.formats import depth_folder
from depthba.convert.recording import Convention, Recording, SourceFrame
from depthba.errors import DatasetError
from depthba.trajectory import write_tum
from tests.depthba.convert import small_scene

READING = Reading(intrinsics=small_scene.LENS, depth_scale=small_scene.STEP)


def folder(path: Path, convention: Convention) -> Path:
    """Write a bare folder whose poses are meant as the convention says."""
    T = small_scene.poses()
    for k, pose in enumerate(T):
        small_scene.write_png(path / f"{k:03d}.png", small_scene.millimetres(pose))
    write_tum(path / "poses.txt", np.arange(6.0), convention.undone(T))
    return path


@pytest.mark.parametrize(
    ("meant", "told"),
    [
        (Convention(axes="opengl"), "expected --axes opengl, or --unchecked"),
        (Convention(direction="world-to-camera"), "expected --direction world-to-camera, or"),
        (
            Convention(scale=0.001),
            "expected --pose-scale 0.001 (points 1.03 m away), or --depth-scale 1 (points 1030 m "
            "away), or --unchecked",
        ),
        (
            Convention("opengl", "world-to-camera", 0.001),
            "--axes opengl --direction world-to-camera with --pose-scale 0.001 (points ",
        ),
    ],
)
def test_a_wrong_convention_is_named(meant: Convention, told: str, tmp_path: Path) -> None:
    path = folder(tmp_path / "set", meant)
    with pytest.raises(DatasetError) as caught:
        importing.read(path, READING)
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)
    right = replace(
        READING, axes=meant.axes, direction=meant.direction, pose_scale=meant.scale, unchecked=False
    )
    found = importing.read(path, right)
    np.testing.assert_allclose(found.T_world_camera, small_scene.poses(), rtol=0, atol=1e-9)
    unchecked = importing.read(path, replace(READING, unchecked=True))
    assert "conventions not checked" in unchecked.notes


@pytest.mark.parametrize("columns", ["yxz", "xzy", "zxy"])
def test_exchanged_columns_are_named(columns: str, tmp_path: Path) -> None:
    path = folder(tmp_path / "set", Convention())
    T = small_scene.poses()
    written = T.copy()
    written[:, :3, 3] = T[:, ["xyz".index(c) for c in columns], 3]
    write_tum(path / "poses.txt", np.arange(6.0), written)
    with pytest.raises(DatasetError) as caught:
        importing.read(path, READING)
    assert f"hold {' '.join(columns)}: expected x y z" in str(caught.value).replace("held", "hold")
    assert "\n" not in str(caught.value)


def test_a_wrong_unit_of_depth_is_named(tmp_path: Path) -> None:
    path = folder(tmp_path / "set", Convention())
    with pytest.raises(DatasetError, match=r"expected --depth-scale 0.001 \(points .*, or --pose-"):
        importing.read(path, replace(READING, depth_scale=1 / 5000))


def test_what_overlap_cannot_tell_is_said() -> None:
    """Parallel cameras over a plane: turned about their own axes they see the same plane."""
    T = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (4, 1, 1))
    T[:, 0, 3] = 0.2 * np.arange(4)
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 60), np.linspace(-0.4, 0.4, 50))
    plane = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    frames = tuple(SourceFrame(f"{k}", float(k), T[k], cloud=lambda: plane) for k in range(4))
    verdict, notes = overlap.check(Recording(Path("planes"), "clouds", frames))
    assert verdict.best == Convention()
    assert Convention(axes="opengl") in verdict.as_good
    assert "the overlap cannot tell that from " in notes[0]


def test_frames_that_share_nothing_are_let_pass_with_a_word(tmp_path: Path) -> None:
    T = small_scene.poses()
    T[:, 0, 3] += 50.0 * np.arange(6)
    path = tmp_path / "set"
    for k, pose in enumerate(small_scene.poses()):
        small_scene.write_png(path / f"{k:03d}.png", small_scene.millimetres(pose))
    write_tum(path / "poses.txt", np.arange(6.0), T)
    recording = importing.read(path, READING)
    assert any("no other convention does better" in text for text in recording.notes)


def test_a_bare_folder_asks_for_what_it_cannot_know(tmp_path: Path) -> None:
    path = folder(tmp_path / "set", Convention())
    assert depth_folder.recognise(path) == "6 images such as 000.png"
    with pytest.raises(DatasetError, match="expected --depth-scale METRES a step"):
        importing.read(path, Reading(intrinsics=small_scene.LENS))
    with pytest.raises(DatasetError, match="expected --intrinsics FX FY CX CY"):
        importing.read(path, Reading(depth_scale=0.001))
    small_scene.write_png(path / "007.png", small_scene.millimetres(small_scene.poses()[0]))
    with pytest.raises(DatasetError, match="6 poses for 7 frames"):
        importing.read(path, READING)


def test_a_damaged_image_is_named_in_a_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = folder(tmp_path / "set", Convention())
    whole = (path / "002.png").read_bytes()
    for data, told in (
        (whole[: len(whole) // 2], "002.png: PNG of .* bytes is cut off"),
        (whole[:60] + b"?" + whole[61:], "002.png: PNG chunk 'IDAT' has a wrong check sum"),
        (b"", "002.png: empty, expected an image"),
        (b"GIF89a", "002.png: begins with b'GIF89a', expected a PNG file"),
    ):
        (path / "002.png").write_bytes(data)
        with pytest.raises(DatasetError, match=told):
            importing.into_dataset(
                importing.read(path, replace(READING, unchecked=True)), tmp_path / "out", READING
            )
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
    small_scene.write_png(path / "002.png", np.zeros((60, 80), np.uint8))
    with pytest.raises(DatasetError, match=r"002.png: pixels of type uint8, expected 16-bit depth"):
        importing.read(path, READING)
    assert capfd.readouterr().err == ""
