"""What a newcomer gets wrong is named, with the next step; and nothing wrong passes in silence."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from depthba import cli
from depthba.convert import Reading, importing, intrinsics
from depthba.dataset import Dataset
from depthba.errors import DatasetError, OptionError
from depthba.trajectory import write_tum
from tests.depthba.convert import small_scene
from tests.depthba.convert.small_scene import millimetres, poses, write_png

READING = Reading(intrinsics=small_scene.LENS, depth_scale=small_scene.STEP)
FRAMES = 4

Change = Callable[[Path], object]


def bare(path: Path) -> Path:
    """Write a folder as the tutorial has it: depth/000000.png and poses.txt."""
    T = poses()[:FRAMES]
    for k, pose in enumerate(T):
        write_png(path / "depth" / f"{k:06d}.png", millimetres(pose))
    write_tum(path / "poses.txt", np.arange(float(FRAMES)), T)
    return path


def lines(change: Callable[[list[str]], list[str]], end: str = "\n", code: str = "utf-8") -> Change:
    """Return what rewrites each line of poses.txt, given as words."""

    def rewrite(path: Path) -> None:
        rows = [line.split() for line in (path / "poses.txt").read_text().splitlines()]
        text = end.join(" ".join(change(row)) for row in rows if row[0] != "#") + end
        (path / "poses.txt").write_bytes(text.encode(code))

    return rewrite


def pictures(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Return what rewrites each image."""

    def rewrite(path: Path) -> None:
        for k, T in enumerate(poses()[:FRAMES]):
            write_png(path / "depth" / f"{k:06d}.png", change(millimetres(T)))

    return rewrite


def same(row: list[str]) -> list[str]:
    return row


def scalar_first(row: list[str]) -> list[str]:
    return [*row[:4], row[7], *row[4:7]]


def stamped(path: Path) -> None:
    for k in range(FRAMES):
        (path / "depth" / f"{k:06d}.png").rename(path / "depth" / f"{1_700_000_000 + k}.125.png")


@pytest.mark.parametrize(
    "change",
    [
        lines(same, "\r\n"),
        lines(same, code="utf-8-sig"),
        lines(same, code="utf-16"),
        lines(lambda row: [",".join(row)]),
        stamped,
        lambda path: path.rename(path.with_name("a folder, with spaces")),
    ],
    ids=["Windows' lines", "mark", "UTF-16", "commas", "numbered poses", "spaces"],
)
def test_what_is_harmless_is_taken(change: Change, tmp_path: Path) -> None:
    change(bare(tmp_path / "set"))
    recording = importing.read(next(tmp_path.iterdir()), READING)
    assert_allclose(recording.T_world_camera, poses()[:FRAMES], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lines(scalar_first), r"expected --quaternions wxyz, or --unchecked"),
        (
            lines(lambda r: [r[0], *(f"{1000 * float(v):.6f}" for v in r[1:4]), *r[4:]]),
            r"expected --pose-scale 0.001 \(points .*\), or --depth-scale 1 \(.*\), or --unchecked",
        ),
        (
            lines(lambda r: [word.replace(".", ",") for word in r]),
            r"line 1: 16 numbers between commas \(decimal commas\? write points\), expected 8",
        ),
        (
            lines(lambda r: [";".join(r)]),
            r"line 2: '1.0.*', expected numbers of poses with decimal",
        ),
        (lines(lambda r: r[1:]), r"7 numbers \(without a stamp\? with angles\?\), expected 8"),
        (lines(lambda r: ["5.0", *r[1:]]), r"poses.txt: 4 poses of stamp 5.000000, expected a"),
        (
            lines(lambda r: [r[0], "nan", *r[2:]]),
            r"line 1: tx is nan, expected a finite number, or no line for a frame without a pose",
        ),
        (
            lambda p: [
                (p / "depth" / f"day{k}").mkdir()
                or (p / "depth" / f"{k:06d}.png").rename(p / f"depth/day{k}/{k:06d}.png")
                for k in range(FRAMES)
            ],
            r"depth/day0/000000.png is an image: depth images lie in the folder .*, all in one",
        ),
        (lambda p: (p / "poses.txt").unlink(), r"files of poses in it: none, .*or --poses FILE"),
        (
            lambda p: shutil.copy(p / "poses.txt", p / "truth.txt"),
            r"poses.txt, truth.txt, expected one .* or --poses FILE",
        ),
        (
            lambda p: shutil.copy(p / "depth/000003.png", p / "depth/000004.png"),
            r"4 poses for 5 frames \(000000.png to 000004.png\), expected one each, or images",
        ),
        (lambda p: (p / "poses.txt").write_text("# stamp\n"), r"expected lines 'stamp tx ty tz qx"),
        (pictures(lambda z: (z / 8).astype(np.uint8)), r"type uint8, .* export the depth itself"),
        (
            pictures(lambda z: np.dstack([z / 8] * 3).astype(np.uint8)),
            r"a picture of 3 channels of uint8, expected depth: .* Colour belongs into rgb/",
        ),
        (
            lambda p: (p / "depth").rename(p / "Depth images"),
            r"but Depth images/000000.png is an image: depth images lie in the folder itself or in",
        ),
        (lambda p: shutil.rmtree(p / "depth"), r"nothing in it is known \(poses.txt\), expected"),
        (
            lambda p: (shutil.rmtree(p / "depth"), (p / "poses.txt").unlink()),
            r"an empty folder, expected a dataset or one of",
        ),
    ],
)
def test_what_is_wrong_is_named(change: Change, told: str, tmp_path: Path) -> None:
    path = bare(tmp_path / "set")
    change(path)
    with pytest.raises(DatasetError, match=told) as caught:
        importing.read(path, READING)
    assert "\n" not in str(caught.value)


def test_quaternions_with_the_scalar_first_are_read_when_it_is_said(tmp_path: Path) -> None:
    path = bare(tmp_path / "set")
    lines(scalar_first)(path)
    recording = importing.read(path, replace(READING, quaternions="wxyz"))
    assert_allclose(recording.T_world_camera, poses()[:FRAMES], rtol=0, atol=1e-9)
    convention = recording.convention
    undone = convention.undone(recording.T_world_camera)
    assert_allclose(convention.applied(undone), recording.T_world_camera, rtol=0, atol=1e-12)


def test_steps_a_metre_are_not_taken_for_metres_a_step(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"--depth-scale 5000: .* 0.0002 for 5000 steps a metre"):
        importing.read(bare(tmp_path / "set"), replace(READING, depth_scale=5000.0))


def test_one_image_is_no_source(tmp_path: Path) -> None:
    file = bare(tmp_path / "set") / "depth/000000.png"
    with pytest.raises(DatasetError, match=r"000000.png: one image, while a source is the folder"):
        importing.read(file, READING)


def test_poses_of_other_frames_are_doubted(tmp_path: Path) -> None:
    """Whatever convention they are explained by."""
    path = bare(tmp_path / "set")
    write_tum(path / "poses.txt", np.arange(float(FRAMES)), poses()[:FRAMES][::-1])
    try:
        told = " ".join(importing.read(path, READING).notes)
    except DatasetError as error:
        told = str(error)
    assert "are the poses those of" in told


def test_intrinsics_of_another_size_are_noticed(tmp_path: Path) -> None:
    other = replace(READING, intrinsics=(525.0, 525.0, 319.5, 239.5))
    with pytest.raises(DatasetError, match="outside of images of 80 x 60 pixels: expected fx fy"):
        importing.read(bare(tmp_path / "set"), other)


@pytest.mark.parametrize(
    ("lens", "told"),
    [
        ((80.0, 39.5, 80.0, 29.5), "fx is 2 times fy, expected fx fy cx cy, not fx cx fy cy?"),
        ((300.0, 39.1, 303.0, 30.2), "fx is 7.7 times fy, expected fx fy cx cy, not fx cx fy cy?"),
        ((28.0, 39.5, 28.0, 29.5), "fy is 1.4 times fx, expected fx fy cx cy, not fx cx fy cy?"),
        (
            (80.0, 80.0, 29.5, 39.5),
            "cx 29.5, cy 39.5 in images of 80 x 60 pixels, expected fx fy cx cy, not fx fy cy cx?",
        ),
    ],
)
def test_intrinsics_in_another_order_are_noticed(
    lens: tuple[float, float, float, float], told: str, tmp_path: Path
) -> None:
    path, other = bare(tmp_path / "set"), replace(READING, intrinsics=lens)
    with pytest.raises(DatasetError) as caught:
        importing.read(path, other)
    given = " ".join(f"{value:g}" for value in lens)
    assert str(caught.value) == f"--intrinsics {given}: {told} or --unchecked"
    importing.read(path, replace(other, unchecked=True))


@pytest.mark.parametrize(
    "lens",
    [
        (40.0, 40.0, 39.5, 29.5),  # a wide lens: fx is about cx
        (80.0, 50.0, 39.5, 29.5),  # stretched
        (80.0, 80.0, 20.0, 45.0),  # cut out of a larger image
        (42.0, 30.0, 41.0, 29.5),  # wide, and stretched
    ],
)
def test_rare_lenses_are_let_pass(lens: tuple[float, float, float, float], tmp_path: Path) -> None:
    """By their numbers; whether frames overlap with them is another matter."""
    images = bare(tmp_path / "set") / "depth/000000.png"
    camera = intrinsics.camera_of(images.parent, images, replace(READING, intrinsics=lens))
    assert intrinsics.pinhole(camera) == lens


def test_sizes_are_told_for_people_to_judge(tmp_path: Path) -> None:
    """Units that are all wrong by one factor change nothing in how frames overlap."""
    path = bare(tmp_path / "set")
    found = []
    for factor in (1.0, 10.0):
        scaled = replace(READING, depth_scale=factor * 0.001, pose_scale=factor)
        told = importing.read(path, scaled).notes[-1]
        assert told.startswith("points lie about ") and "from the cameras, whose places" in told
        found.append(float(told.split()[3]))
    assert found[1] == pytest.approx(10 * found[0], rel=0.01)


def test_frames_without_any_depth_do_not_pass_in_silence(tmp_path: Path) -> None:
    path = bare(tmp_path / "set")
    write_png(path / "depth/000002.png", np.zeros((60, 80), np.uint16))
    found = importing.into_dataset(importing.read(path, READING), tmp_path / "some", READING)
    assert "nothing was measured in 1 frame (000002.png)" in found.notes
    pictures(np.zeros_like)(path)
    with pytest.raises(DatasetError, match=r"nothing was measured in any frame \(000000.png and"):
        importing.into_dataset(importing.read(path, READING), tmp_path / "none", READING)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["convert", "{set}", "{out}", "--depth-range", "300", "2000"], "crop or the mask leaves"),
        (["convert", "{set}", "{out}", "--roi", "5", "6", "5", "6", "0", "1"], "ranges in metres"),
        (
            ["register", "{set}", "--out", "{out}", "--depth-range", "300", "2000"],
            "that its crop and its mask leave: expected --depth-range in metres",
        ),
        (
            ["register", "{set}", "--out", "{out}", "--roi", "5", "6", "5", "6", "0", "1"],
            "of the map frame, m: the points lie in -",
        ),
        (["plot", "{set}"], "expected a run, as `depthba register DATASET --out RUN` leaves it"),
        (["evaluate", "{set}"], "expected a run, as `depthba register DATASET --out RUN` leaves"),
        (["doctor", "{new}"], "no dataset.json in it, expected a dataset; `depthba convert` makes"),
    ],
)
def test_verbs_say_the_next_step(
    words: list[str],
    told: str,
    depth_set: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "new").mkdir()
    places = {"set": depth_set.path, "out": tmp_path / "out", "new": tmp_path / "new"}
    assert cli.main([word.format(**places) for word in words]) == 1
    said = capsys.readouterr()
    assert told in said.err + said.out
    assert [p.name for p in tmp_path.iterdir()] == ["new"]
