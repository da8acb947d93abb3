"""Which pose belongs to which image: by stamps of one clock, by order, or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from depthba.convert.pairing import by_name
from depthba.convert.pose_files import Poses
from depthba.errors import DatasetError

COUNT = 12
CLOCK = 1_700_000_000.0 + 0.5 * np.arange(COUNT)
RELATIVE = 0.5 * np.arange(COUNT)
ORDER = ("poses belong to the frames in their order",)


def poses(stamps: np.ndarray | None, number: int = COUNT) -> Poses:
    T = np.tile(np.eye(4), (number, 1, 1))
    T[:, 0, 3] = np.arange(number)
    return Poses(Path("poses.txt"), T, stamps)


def files(names: list[str]) -> list[Path]:
    return [Path("depth") / f"{name}.png" for name in names]


def seconds(stamps: np.ndarray) -> list[Path]:
    return files([f"{stamp:.6f}" for stamp in stamps])


def refusal(found: list[Path], stamps: np.ndarray | None, number: int = COUNT) -> str:
    with pytest.raises(DatasetError) as caught:
        by_name(found, poses(stamps, number), 0.1)
    told = str(caught.value)
    assert "\n" not in told
    return told


@pytest.mark.parametrize("number", [COUNT, COUNT - 1])
@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "µs"), (1e9, "ns")])
@pytest.mark.parametrize("start", [CLOCK, RELATIVE], ids=["since 1970", "from 0"])
def test_stamps_of_poses_in_another_unit_are_named(
    start: np.ndarray, factor: float, unit: str, number: int
) -> None:
    """Also where an image is missing, so that nothing could be joined by order."""
    told = refusal(seconds(start[:number]), start * factor)
    assert f": {factor:.0f} times as large ({unit}?), expected seconds" in told


def test_the_line_tells_both_ranges() -> None:
    assert refusal(seconds(CLOCK), CLOCK * 1000) == (
        "poses.txt: stamps 1700000000000 to 1700000005500, but images are named 1700000000.000000 "
        "to 1700000005.500000: 1000 times as large (ms?), expected seconds"
    )
    assert "named 1700000000000.0 to 1700000005500.0, 1000 times as large (ms?), expected" in (
        refusal(files([f"{1000 * stamp:.1f}" for stamp in CLOCK]), CLOCK)
    )


@pytest.mark.parametrize(
    ("found", "stamps", "apart"),
    [
        (seconds(CLOCK), CLOCK + 3600, "3600 s earlier"),
        (seconds(CLOCK), CLOCK - 7.5, "7.5 s later"),
        (seconds(CLOCK), RELATIVE, "1700000000 s later"),
        (seconds(RELATIVE), CLOCK, "1700000000 s earlier"),
        (files([f"{1000 * s:.0f}" for s in CLOCK]), CLOCK + 3600, "3600 s earlier"),
        (seconds(CLOCK[:-1]), CLOCK + 3600, "3600 s earlier"),
    ],
)
def test_stamps_of_another_clock_are_named(
    found: list[Path], stamps: np.ndarray, apart: str
) -> None:
    told = refusal(found, stamps)
    assert f", {apart}: two clocks? Expected stamps of one clock: shift" in told
    assert "or number the images 000000, 000001, … to join them in order" in told


@pytest.mark.parametrize(
    "names",
    [
        [f"{k:06d}" for k in range(COUNT)],
        [f"frame{k}_depth" for k in range(COUNT)],
        [f"{k:010d}" for k in range(COUNT)],
        [f"shot1.{k:04d}" for k in range(3, COUNT + 3)],
        [f"1700000000_{k}" for k in range(COUNT)],
    ],
    ids=["zeros", "words", "ten digits", "after a point", "after a date"],
)
@pytest.mark.parametrize("stamps", [CLOCK, CLOCK * 1000, RELATIVE + 7.25])
def test_numbers_of_frames_are_joined_in_order(names: list[str], stamps: np.ndarray) -> None:
    paired, notes = by_name(files(names), poses(stamps), 0.1)
    assert [T[0, 3] for _, _, T in paired] == list(range(COUNT))
    assert notes == ORDER


@pytest.mark.parametrize("first", [0, 1])
def test_numbered_poses_have_no_clock_to_be_of_another(first: int) -> None:
    paired, notes = by_name(seconds(CLOCK), poses(np.arange(float(first), COUNT + first)), 0.1)
    assert len(paired) == COUNT and notes == ORDER


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
def test_a_pose_without_an_image_is_noted(unit: float) -> None:
    names = [f"{s:.6f}" if unit == 1.0 else f"{s * unit:.0f}" for s in np.delete(CLOCK, 5)]
    paired, notes = by_name(files(names), poses(CLOCK), 0.1)
    assert [T[0, 3] for _, _, T in paired] == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11]
    assert notes == ("1 pose without an image (stamp 1700000002.5)",)


def test_poses_that_images_lie_between_are_not_spare() -> None:
    """A tracker gives hundreds a second."""
    dense = np.arange(CLOCK[0] - 1, CLOCK[-1] + 1, 0.01) + 0.003
    assert by_name(seconds(CLOCK), poses(dense, len(dense)), 0.1)[1] == ()


@pytest.mark.parametrize(
    ("there", "told"),
    [
        ([0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11], "(000000.png to 000011.png): 000005 is missing,"),
        ([0, 1, 4, 5, 6, 7, 8, 9, 10, 11], "000011.png): 000002 and 1 more are missing, expected"),
        (list(range(11)), "12 poses for 11 frames (000000.png to 000010.png), expected one each"),
        ([*range(13), 14], "12 poses for 14 frames (000000.png to 000014.png), expected one each"),
    ],
)
def test_a_missing_image_is_named(there: list[int], told: str) -> None:
    assert told in refusal(files([f"{k:06d}" for k in there]), None)
    assert told in refusal(files([f"{k:06d}" for k in there]), CLOCK)
