"""Boards to print: their size in the file is the size on paper, and OpenCV finds them."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from depthba.board_print import BAR, black, layout, pixels_per_metre, write
from depthba.boards import Board
from depthba.cli import main
from depthba.errors import OptionError

BOARDS = ["10x7x0.02", "charuco:10x7x0.0213", "charuco:5x7x0.025:DICT_5X5_100:0.018"]


def boxes_of_pdf(path: Path) -> tuple[tuple[float, float], list[np.ndarray]]:
    """The page, mm, and every filled path as boxes (n, 4), mm, from the top left corner."""
    data = path.read_bytes()
    found = re.search(rb"/MediaBox \[ ([\d. ]+)\]", data)
    assert found
    _, _, width, height = (float(v) * 25.4 / 72 for v in found[1].split())
    streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", data, re.S)
    texts = []
    for stream in streams:
        try:
            texts.append(zlib.decompress(stream).decode("latin-1"))
        except zlib.error:
            continue
    content = next(text for text in texts if " m\n" in text and " l\n" in text)
    paths = []
    for block in re.split(r"\nf\n", content):
        corners = np.array(re.findall(r"([-\d.]+) ([-\d.]+) [ml]\n", block), float) * 25.4 / 72
        if len(corners) % 4 or len(corners) == 0:
            continue
        corners = corners.reshape(-1, 4, 2)
        corners[..., 1] = height - corners[..., 1]
        paths.append(np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1))
    return (width, height), paths


@pytest.mark.parametrize("words", BOARDS)
def test_on_paper_the_board_has_its_size(tmp_path: Path, words: str) -> None:
    board = Board.parse(words)
    path = tmp_path / "board.pdf"
    assert main(["calibrate", "--board", words, "--print-board", str(path), "--page", "A3"]) == 0
    page, paths = boxes_of_pdf(path)
    assert sorted(page) == pytest.approx([297.0, 420.0], abs=1e-3)
    drawn = next(boxes for boxes in paths if len(boxes) == len(black(board)))
    # To a thousandth of a millimetre, over the whole board.
    at = drawn[0, :2] - 1e3 * black(board)[0, :2]
    np.testing.assert_allclose(drawn, 1e3 * black(board) + np.tile(at, 2), atol=1e-3)
    assert (drawn[:, :2] >= 5.0).all() and (drawn[:, 2:] <= np.array(page) - 5.0).all()
    bar = next(boxes for boxes in paths if len(boxes) == 12)
    assert bar[:, 2].max() - bar[:, 0].min() == pytest.approx(BAR, abs=1e-3)
    assert bar[:, 1].min() > drawn[:, 3].max() + 1.0


@pytest.mark.parametrize("words", BOARDS)
def test_opencv_finds_the_picture_where_it_should_be(tmp_path: Path, words: str) -> None:
    board, path = Board.parse(words), tmp_path / "board.png"
    sheet = layout(board, "A3")
    write(sheet, path)
    image = Image.open(path)
    fine = pixels_per_metre(board)
    # What the file states, in dots an inch, is what it was drawn with.
    assert image.info["dpi"][0] / 0.0254 == pytest.approx(fine, rel=1e-6)
    assert abs(fine * board.square_m - round(fine * board.square_m)) < 5e-3
    assert np.array(image.size) / fine * 1e3 == pytest.approx(sheet.page, abs=0.1)
    grey = np.asarray(image.convert("L"))
    # Half as fine: a camera sees no more, and OpenCV is quicker.
    small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    ids, corners = board.detect(small)
    assert len(ids) == board.columns * board.rows
    at = (2.0 * (corners + 0.5) - 0.0) / fine * 1e3
    expected = 1e3 * board.corners()[ids, :2] + sheet.at
    # The page's lower edge may cut a pixel: half of one, 0.04 mm.
    assert np.abs(at - expected).max() < 0.06
    spread = np.ptp(at, axis=0) / np.ptp(expected, axis=0)
    assert np.abs(spread - 1.0).max() < 3e-4


def test_what_cannot_be_printed_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(OptionError, match=r"330 x 240 mm of squares .* fits: a0, a1, a2, a3"):
        layout(Board.parse("10x7x0.03"), "A4")
    with pytest.raises(OptionError, match="expected one of a0"):
        layout(Board(), "A9")
    there = tmp_path / "board.pdf"
    there.write_text("mine")
    words = ["calibrate", "--board", "10x7x0.02", "--print-board"]
    for file, said in (
        (there, "is there already, expected --overwrite"),
        (tmp_path / "board.jpg", "ends in .pdf or .png"),
    ):
        assert main([*words, str(file)]) == 1
        assert said in capsys.readouterr().err
    assert there.read_text() == "mine"
    assert main(["calibrate"]) == 1
    assert "no dataset" in capsys.readouterr().err
    assert main([*words, str(there), "--overwrite"]) == 0
    assert there.read_bytes().startswith(b"%PDF")
