"""A calibration board to print: on a page of true size, with a bar to measure the print by."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import durable
from depthba.boards import Board
from depthba.errors import OptionError

Array = NDArray[np.float64]

PAGES = {
    "a0": (841.0, 1189.0),
    "a1": (594.0, 841.0),
    "a2": (420.0, 594.0),
    "a3": (297.0, 420.0),
    "a4": (210.0, 297.0),
    "a5": (148.0, 210.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}
"""Width and height, mm, upright."""

BAR = 100.0
"""Length of the bar to measure the print by, mm."""
FOOT = 20.0
"""Height of the strip for bar and words, mm."""
EDGE = 5.0
"""What printers leave white along the edges, mm."""
RIM = 0.25
"""What must stay white around the squares, in squares."""
PIXELS = 11811
"""Of a metre of the picture, about 300 dots an inch."""

_MM_PER_INCH, _POINTS_PER_MM = 25.4, 72.0 / 25.4


@dataclass(frozen=True)
class Sheet:
    """A board on a page."""

    board: Board
    page: tuple[float, float]
    """Width and height, mm."""
    at: tuple[float, float]
    """Where the board frame's origin lies, mm, from the page's top left corner, right and down."""


def layout(board: Board, page: str = "A4") -> Sheet:
    """Lay a board in the middle of a page, upright or across, as it fits.

    Args:
        board: what is drawn; its squares keep their size.
        page: a name of `PAGES`, or width and height in mm, as ``400x300``, which is not turned.

    Raises:
        OptionError: no such page, or the board is too large for it.
    """
    width, height = 1e3 * board.square_m * np.array([board.columns + 1, board.rows + 1])
    rim = 1e3 * RIM * board.square_m
    need = (width + 2 * max(rim, EDGE), height + 2 * max(rim, EDGE) + FOOT)
    sizes = _sizes(page)
    for size in sizes:
        if need[0] <= size[0] and need[1] <= size[1]:
            square = 1e3 * board.square_m
            left, top = 0.5 * (size[0] - width), 0.5 * (size[1] - FOOT - height)
            return Sheet(board, size, (left + square, top + square))
    larger = [
        name
        for name, (a, b) in PAGES.items()
        if (need[0] <= a and need[1] <= b) or (need[0] <= b and need[1] <= a)
    ]
    fits = f"; fits: {', '.join(larger)}" if larger else ""
    raise OptionError(
        f"--page {page}: {width:g} x {height:g} mm of squares need {need[0]:g} x {need[1]:g} mm"
        f" with their rim and foot, expected a larger page or smaller squares{fits}"
    )


def _sizes(page: str) -> list[tuple[float, float]]:
    named = PAGES.get(page.lower())
    if named is not None:
        return [named, (named[1], named[0])]
    found = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", page.lower())
    if found is None or not all(0 < float(v) <= 5000 for v in found.groups()):
        raise OptionError(
            f"--page {page}: expected one of {', '.join(PAGES)}, or mm as 400x300, 5000 at most"
        )
    return [(float(found[1]), float(found[2]))]


def write(sheet: Sheet, path: Path, overwrite: bool = False) -> None:
    """Draw a sheet into a .pdf, in lines, or a .png of about 300 dots an inch that states its size.

    The file is written whole or not at all.

    Raises:
        OptionError: another kind of file, or one that is there already.
    """
    kind = path.suffix.lower()
    if kind not in (".pdf", ".png"):
        raise OptionError(f"--print-board {path}: expected a name that ends in .pdf or .png")
    if path.exists() and not overwrite:
        raise OptionError(f"--print-board {path}: is there already, expected --overwrite")
    path.parent.mkdir(parents=True, exist_ok=True)
    durable.write_bytes(path, _drawn(sheet, kind[1:]))


def _drawn(sheet: Sheet, kind: str) -> bytes:
    """The page as a file's bytes."""
    from io import BytesIO

    from matplotlib import rc_context
    from matplotlib.figure import Figure

    width, height = sheet.page
    figure: Any = Figure(figsize=(width / _MM_PER_INCH, height / _MM_PER_INCH), facecolor="white")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set(xlim=(0.0, width), ylim=(height, 0.0))
    axes.add_patch(_path(black(sheet.board) * 1e3 + np.tile(sheet.at, 2)))
    _draw_foot(axes, sheet)
    buffer = BytesIO()
    dots = _MM_PER_INCH * 1e-3 * pixels_per_metre(sheet.board)
    with rc_context({"pdf.fonttype": 42, "path.simplify": False}):
        more = {"metadata": {"CreationDate": None}} if kind == "pdf" else {}
        figure.savefig(buffer, format=kind, dpi=dots, **more)
    return buffer.getvalue()


def black(board: Board) -> Array:
    """What is black of a board: rectangles (n, 4), x0 y0 x1 y1, m, board frame."""
    row, column = np.mgrid[: board.rows + 1, : board.columns + 1]
    odd = (row + column) % 2 == 0
    corner = np.stack([column[odd], row[odd]], axis=-1) - 1.0
    squares = board.square_m * np.concatenate([corner, corner + 1.0], axis=-1)
    return np.concatenate([squares, board.marker_cells()])


def pixels_per_metre(board: Board) -> int:
    """How fine the picture is: squares of whole pixels, and a whole number to state in the file."""
    side = board.square_m
    pixels = np.arange(max(1, int(0.8 * PIXELS * side)), int(1.25 * PIXELS * side) + 2)
    fine = pixels / side
    # What a PNG can state are whole numbers; of those that hit best, the nearest to 300 dots.
    miss = np.round(np.abs(fine - np.round(fine)) / fine, 9)
    best = np.lexsort((np.abs(fine - PIXELS), miss))[0]
    return round(float(fine[best]))


def _path(boxes: Array) -> Any:
    """One filled path of rectangles (n, 4): neighbours in one path leave no seam between them."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    x0, y0, x1, y1 = boxes.T
    points = np.stack([x0, y0, x1, y0, x1, y1, x0, y1, x0, y0], axis=-1).reshape(-1, 2)
    codes = [Outline.MOVETO, *[Outline.LINETO] * 3, Outline.CLOSEPOLY] * len(boxes)
    return PathPatch(Outline(points, codes), facecolor="black", edgecolor="none", linewidth=0.0)


def _draw_foot(axes: Any, sheet: Sheet) -> None:
    """The bar with its ends, and what the board is."""
    board, (width, height) = sheet.board, sheet.page
    left, top = 0.5 * (width - BAR), height - 0.75 * FOOT
    if width < BAR + 2 * EDGE:
        raise OptionError(f"a page {width:g} mm wide: expected {BAR + 2 * EDGE:g} mm or more")
    thick, boxes = 0.3, [(left, top, left + BAR, top + 0.3)]
    for k in range(0, int(BAR) + 1, 10):
        # The outer edges of the end ones are where the bar ends: it measures from edge to edge.
        x = left + min(k, BAR - thick)
        boxes.append((x, top, x + thick, top + (1.5 if k % 50 else 3.0)))
    axes.add_patch(_path(np.array(boxes)))
    name = f"{board.columns}x{board.rows}x{board.square_m:g}"
    what = f"--board {'charuco:' if board.kind == 'charuco' else ''}{name}"
    if board.kind == "charuco":
        what += f":{board.dictionary}:{board.marker_m:g}"
    size = 1e3 * board.square_m
    words = (
        f"{what}      squares {size:g} mm, {board.columns + 1} x {board.rows + 1} of them:"
        f" {size * (board.columns + 1):g} x {size * (board.rows + 1):g} mm\n"
        f"print at 100 %: the bar above is {BAR:g} mm long; if not, state the squares as measured"
    )
    axes.text(
        0.5 * width, top + 4.0, words, ha="center", va="top", fontsize=2.4 * _POINTS_PER_MM,
        linespacing=1.3,
    )  # fmt: skip
