"""TUM files: exact round trips, strict reading, and a crash in the last line."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from depthba import se3
from depthba.errors import DatasetError
from depthba.trajectory import parse_tum, read_tum, tum_line, write_tum


def some_poses(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    T = se3.make(se3.exp_so3(rng.normal(size=(n, 3))), rng.normal(size=(n, 3)) * 10)
    return 1.7e9 + np.arange(n) * 0.1, T


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 6), st.integers(0, 10_000))
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, n: int, seed: int) -> None:
    path = tmp_path_factory.mktemp("tum") / "poses.txt"
    stamps, T = some_poses(n, seed)
    write_tum(path, stamps, T, comment="two\nlines")
    back_stamps, back_T = read_tum(path)
    np.testing.assert_allclose(back_stamps, stamps, rtol=0, atol=1e-6)
    np.testing.assert_allclose(back_T, T, atol=1e-13)
    assert back_T.shape == (n, 4, 4)


def test_lines_have_enough_decimals_and_no_exponents() -> None:
    line = tum_line(1e-7, se3.make(se3.exp_so3([1e-9, 0, 0]), [-1e-17, 1e-12, 12345.678]))
    words = line.split()
    assert len(words) == 8
    assert all(re.fullmatch(r"-?\d+\.\d{9,}", word) for word in words)
    assert words[1] == "0.000000000000000"
    with pytest.raises(ValueError, match="not finite"):
        tum_line(0, np.full((4, 4), np.nan))


def test_a_quaternion_within_the_tolerance_is_normalised(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("0 1 2 3 0 0 0 1.0000009  # a comment\n\n# more\n1 1 2 3 0 0 0 -0.9999991\n")
    stamps, T = read_tum(path)
    np.testing.assert_array_equal(stamps, [0, 1])
    np.testing.assert_allclose(T[:, :3, :3], np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-15)


BAD = {
    "nan": ("1 nan 2 3 0 0 0 1", "line 2: tx is nan, expected a finite number"),
    "inf": ("1 0 2 -inf 0 0 0 1", "line 2: tz is -inf, expected a finite number"),
    "stamp": ("NaN 0 2 0 0 0 0 1", "line 2: stamp is nan"),
    "not unit": (
        "1 0 2 3 0 0 0.1 1",
        "line 2: quaternion of length 1.00498756, expected 1 to 1e-06",
    ),
    "a little off": ("1 0 2 3 0 0 0 1.0000011", "line 2: quaternion of length 1.0000011"),
    "no rotation": ("1 0 2 3 0 0 0 0", "line 2: quaternion of length 0"),
    "seven": ("1 0 2 3 0 0 1", "line 2: 7 values in '1 0 2 3 0 0 1', expected 8"),
    "nine": ("1 0 2 3 0 0 0 1 5", "line 2: 9 values"),
    "word": ("1 0 x 3 0 0 0 1", "line 2: 'x' is not a number"),
}


@pytest.mark.parametrize("case", BAD)
def test_malformed(case: str, tmp_path: Path) -> None:
    line, message = BAD[case]
    path = tmp_path / "poses.txt"
    path.write_text(f"0 0 0 0 0 0 0 1\n{line}\n2 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match=re.escape(f"{path}: {message}")) as error:
        read_tum(path)
    assert "\n" not in str(error.value)


def test_not_text_and_no_file(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_bytes(b"0 0 0\xff")
    with pytest.raises(DatasetError, match="byte 5 is not UTF-8"):
        read_tum(tmp_path / "poses.txt")
    with pytest.raises(DatasetError, match=r"none\.txt: no such file"):
        read_tum(tmp_path / "none.txt")


def test_a_last_line_cut_anywhere_costs_at_most_that_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "poses.txt"
    stamps, T = some_poses(3)
    write_tum(path, stamps, T)
    whole = path.read_bytes()
    start = whole.rindex(b"\n", 0, -1) + 1
    for end in range(start, len(whole)):
        path.write_bytes(whole[:end])
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            _, back = read_tum(path)
        assert len(back) in (2, 3)
        # what is kept in spite of the cut is the pose to the accuracy of the format
        np.testing.assert_allclose(back, T[: len(back)], atol=2e-6)
        assert ("line 4: dropped the truncated last line" in caplog.text) == (
            len(back) == 2 and end > start
        )


def test_all_faults_are_reported_and_the_good_poses_kept() -> None:
    faults: list[tuple[int, str]] = []
    trajectory = parse_tum(
        "0 0 0 0 0 0 0 1\n1 nan 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n3 0\n",
        lambda line, text: faults.append((line, text)),
    )
    assert [line for line, _ in faults] == [2, 4]
    np.testing.assert_array_equal(trajectory.stamps, [0, 2])
