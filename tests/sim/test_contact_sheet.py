from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sim.contact_sheet import contact_sheet, statistics
from sim.noise import STAGES, choose_stages
from sim.sensors import SP1000, ZED2, DepthSensor
from tests.sim.shots import OVER_THE_TABLE, shot_of, table

GREEN = np.array([0x51, 0xA6, 0x00])
"""Of holes, as OpenCV has it."""


def sheet(path: Path, sensor: DepthSensor, stages: tuple = STAGES) -> bytes:
    shot = shot_of(table(), sensor, OVER_THE_TABLE)
    contact_sheet(path, "a table", sensor, stages, shot, seed=1, frame=0)
    return path.read_bytes()


def test_equal_inputs_give_equal_bytes(tmp_path: Path) -> None:
    sensor = ZED2.resized(320, 180)
    first = sheet(tmp_path / "a.png", sensor)
    assert first.startswith(b"\x89PNG") and b"matplotlib" not in first
    assert sheet(tmp_path / "b.png", sensor) == first


@pytest.mark.parametrize("size", [(96, 72), (1280, 960)])
def test_a_sheet_has_a_size_to_look_at_whatever_the_sensors(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    image = cv2.imdecode(np.frombuffer(sheet(tmp_path / "a.png", SP1000.resized(*size)), "u1"), 1)
    assert 1600 < image.shape[1] < 2400 and 1000 < image.shape[0] < 1600
    assert 500 < (image == GREEN).all(axis=2).sum() < 0.1 * image[..., 0].size


def test_clean_depth_shows_no_holes(tmp_path: Path) -> None:
    sheet(tmp_path / "a.png", ZED2.resized(320, 180), choose_stages(clean=True))
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None and not (image == GREEN).all(axis=2).any()


def test_the_numbers_of_a_stage() -> None:
    before = np.full((10, 10), 2.0)
    after = before.copy()
    after[0] = [np.nan] * 4 + [2.001, 1.999] * 3
    assert statistics(before, after) == "σ 1 mm, median size 1 mm on 6 %; holes 4 %"
    assert statistics(before, before) == "no depth changed; no holes"
