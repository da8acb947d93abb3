"""Writing calibration.json: what is read back is what was given, or nothing was written."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from depthba import se3
from depthba.boards import Board
from depthba.dataset import Dataset, DatasetWriter, verify
from depthba.errors import DatasetError

X = se3.make(se3.exp_so3([0.1, -0.2, 3.0]), [0.01, -0.06, 0.04])
WHOLE = {"board": Board().json(), "T_flange_camera_true": X, "T_base_board_true": np.eye(4)}


def test_what_is_read_back_is_what_was_written(small: Any) -> None:
    writer = DatasetWriter.resume(small.path)
    writer.write_calibration(WHOLE | {"T_flange_camera_true": np.eye(4)})
    writer.write_calibration(WHOLE | {"temperature": 21.5})
    calibration = Dataset.open(small.path).calibration()
    assert calibration is not None and calibration["temperature"] == 21.5
    assert Board.from_json(calibration["board"]) == Board()
    np.testing.assert_array_equal(calibration["T_flange_camera_true"], X)
    np.testing.assert_array_equal(calibration["T_base_board_true"], np.eye(4))
    assert verify(small.path) == []


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "no rotation": ({"T_base_board_true": np.diag([1.0, 1, 2, 1])}, "expected a rigid transform"),
    "NaN": ({"T_flange_camera_true": np.full((4, 4), np.nan)}, "no JSON"),
    "no squares": ({"board": Board().json() | {"columns": 0}}, "board.columns is 0, expected an"),
    "no side": ({"board": Board().json() | {"square_m": 0.0}}, "board.square_m is 0.0, expected"),
    "no JSON": ({"board": Board()}, "no JSON"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_could_not_be_read_is_refused(case: str, small: Any) -> None:
    change, text = WRONG[case]
    writer = DatasetWriter.resume(small.path)
    with pytest.raises(DatasetError, match=r"calibration\.json: .*" + re.escape(text)):
        writer.write_calibration(WHOLE | change)
    assert not (small.path / "calibration.json").exists()
