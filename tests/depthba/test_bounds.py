"""What a head claims is held against what is there, before any memory is taken."""

from __future__ import annotations

import io
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from depthba import bounds, documents
from depthba.dataset import Dataset
from depthba.errors import DatasetError, DepthbaError


def test_a_sensor_of_too_many_pixels_is_refused(small: Any) -> None:
    small.change(sensor__width=100_000, sensor__height=100_000)
    with pytest.raises(DatasetError, match="100000 x 100000 pixels, expected 160"):
        Dataset.open(small.path)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".bmp", ".pgm"])
def test_heads_of_images_are_understood(suffix: str) -> None:
    data = bytes(cv2.imencode(suffix, np.zeros((6, 8), np.uint8))[1])
    bounds.check_image(data)
    if suffix == ".tif":
        floats = bytes(cv2.imencode(suffix, np.zeros((6, 8), np.float32))[1])
        bounds.check_image(floats)
    with pytest.raises(ValueError, match="head"):
        bounds.check_image(data[:4])


def test_an_image_of_too_many_pixels_is_refused_by_its_head() -> None:
    with pytest.raises(ValueError, match="10000 x 9000 pixels, expected 16000000 at most"):
        bounds.check_image(b"P5\n10000 9000\n255\n" + bytes(100))
    with pytest.raises(ValueError, match="far more pixels"):
        bounds.check_image(b"P5\n40000 30000\n255\n" + bytes(100))


def test_an_array_has_the_bytes_that_its_head_says() -> None:
    file = io.BytesIO()
    np.save(file, np.arange(12.0).reshape(3, 4))
    data = file.getvalue()
    assert (bounds.read_array(data) == np.arange(12.0).reshape(3, 4)).all()
    with pytest.raises(ValueError, match="95 bytes of numbers, expected 96"):
        bounds.read_array(data[:-1])
    file = io.BytesIO()
    np.save(file, np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="objects"):
        bounds.read_array(file.getvalue())


def test_aliases_that_multiply_are_refused_and_others_are_not() -> None:
    assert documents.parse_yaml("a: &x [1, 2]\nb: *x\nc: *x\n") == {
        "a": [1, 2], "b": [1, 2], "c": [1, 2],
    }  # fmt: skip
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 9)]
    with pytest.raises(yaml.YAMLError, match="aliases stand for more than"):
        documents.parse_yaml("\n".join(lines))
    with pytest.raises(yaml.YAMLError, match="lies in what it stands for"):
        documents.parse_yaml("&a [*a]")
    with pytest.raises(yaml.YAMLError, match="nested deeper"):
        documents.parse_yaml("[" * 5000)
    with pytest.raises(ValueError, match="nested too deep"):
        documents.parse_json("[" * 100_000)
    assert documents.parse_json("1" * 400) == float("inf")


def test_an_error_stays_a_line_that_can_be_read() -> None:
    line = str(DepthbaError("begin " + "x" * 100_000 + " end"))
    assert len(line) < 1600 and line.startswith("begin") and line.endswith("end")
