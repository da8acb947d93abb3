"""Calibration boards: what is printed on them, and where a camera sees it.

Board frame: the origin is the first inner corner, the one with a black square above and to its
left (as printed); x runs along the columns (right), y along the rows (down), and z = x x y points
into the board, away from who looks at it. A camera that faces a board so as to read it upright has
its axes along the board's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from depthba.dataset import fields
from depthba.dataset.faults import MalformedError
from depthba.errors import OptionError

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Kind = Literal["checkerboard", "charuco"]

KINDS = ("checkerboard", "charuco")


@dataclass(frozen=True)
class Board:
    """A board of (columns + 1) x (rows + 1) squares, the first of them black."""

    kind: Kind = "checkerboard"
    columns: int = 10
    """Inner corners along x; for ChArUco too, where OpenCV counts squares: one more."""
    rows: int = 7
    """Inner corners along y. With columns + rows even a checkerboard looks the same after half a
    turn, so that its first corner cannot be told from its last."""
    square_m: float = 0.03
    """Side of a square, m."""
    dictionary: str | None = None
    """OpenCV's name of the markers' dictionary, as DICT_4X4_50; checkerboard: None."""
    marker_m: float | None = None
    """Side of a marker, m; checkerboard: None."""

    def __post_init__(self) -> None:
        """OptionError names a value that makes no board."""
        if self.kind not in KINDS:
            raise OptionError(f"board kind {self.kind!r}: expected one of {', '.join(KINDS)}")
        if self.columns < 2 or self.rows < 2:
            raise OptionError(
                f"board of {self.columns} x {self.rows} inner corners: expected at least 2 x 2"
            )
        if not (np.isfinite(self.square_m) and self.square_m > 0.0):
            raise OptionError(f"board square_m {self.square_m}: expected a number above 0")
        if self.kind == "checkerboard":
            if self.dictionary is not None or self.marker_m is not None:
                raise OptionError("dictionary or marker_m of a checkerboard: expected none")
        elif self.dictionary is None or self.marker_m is None:
            raise OptionError("a ChArUco board needs its dictionary and marker_m")
        else:
            if not 0.0 < self.marker_m < self.square_m:
                raise OptionError(
                    f"board marker_m {self.marker_m}: expected more than 0 and less than"
                    f" square_m {self.square_m}"
                )
            self._check_dictionary(self.dictionary)

    @staticmethod
    def charuco(columns: int = 10, rows: int = 7, square_m: float = 0.03) -> Board:
        """A ChArUco board of 4 x 4-bit markers that fill three quarters of the white squares."""
        return Board("charuco", columns, rows, square_m, "DICT_4X4_50", 0.75 * square_m)

    @staticmethod
    def parse(text: str) -> Board:
        """The board of words such as ``10x7x0.03``: inner corners along x and y, m a square.

        ``charuco:10x7x0.03`` is a ChArUco board as `charuco` makes it; a dictionary and a marker's
        side, m, may follow: ``charuco:10x7x0.03:DICT_5X5_100:0.022``. OptionError says what is
        wrong.
        """
        kind, _, rest = text.rpartition(":") if text.count(":") == 0 else text.partition(":")
        sizes, *markers = rest.split(":")
        numbers = sizes.lower().split("x")
        try:
            columns, rows, square = int(numbers[0]), int(numbers[1]), float(numbers[2])
            if len(numbers) != 3 or kind not in ("", *KINDS):
                raise ValueError
            if kind != "charuco":
                if markers:
                    raise ValueError
                return Board("checkerboard", columns, rows, square)
            plain = Board.charuco(columns, rows, square)
            dictionary = markers[0] if markers else plain.dictionary
            marker = float(markers[1]) if len(markers) > 1 else plain.marker_m
        except (ValueError, IndexError):
            raise OptionError(
                f"board {text!r}: expected inner corners along x and y and the side of a square in"
                " metres, as 10x7x0.03 or charuco:10x7x0.03"
            ) from None
        return Board("charuco", columns, rows, square, dictionary, marker)

    @staticmethod
    def from_json(value: Any) -> Board:  # JSON is untyped until it is checked
        """The board of calibration.json's key `board`. OptionError names what is wrong with it."""
        try:
            record = fields.mapping(value, "board")
            kind = fields.choice(fields.required(record, "kind"), "board.kind", KINDS)
            count = {
                key: fields.integer(fields.required(record, key), f"board.{key}", least=2)
                for key in ("columns", "rows")
            }
            square = fields.number(fields.required(record, "square_m"), "board.square_m", above=0)
            dictionary, marker = record.get("dictionary"), record.get("marker_m")
            if dictionary is not None:
                fields.text(dictionary, "board.dictionary")
            if marker is not None:
                marker = fields.number(marker, "board.marker_m", above=0)
        except MalformedError as error:
            raise OptionError(str(error)) from error
        named: Kind = "charuco" if kind == "charuco" else "checkerboard"
        return Board(named, count["columns"], count["rows"], square, dictionary, marker)

    def json(self) -> dict[str, Any]:
        """What calibration.json holds of the board."""
        record: dict[str, Any] = {
            "kind": self.kind,
            "columns": self.columns,
            "rows": self.rows,
            "square_m": self.square_m,
        }
        if self.kind == "charuco":
            record |= {"dictionary": self.dictionary, "marker_m": self.marker_m}
        return record

    def corners(self) -> Array:
        """The inner corners (columns * rows, 3), m, board frame, row after row: id = row of it."""
        y, x = np.mgrid[: self.rows, : self.columns]
        flat = np.zeros_like(x, float)
        return np.asarray(self.square_m * np.stack([x, y, flat], axis=-1).reshape(-1, 3))

    def sheet(self, margin: float = 0.5) -> Array:
        """The four corners (4, 3), m, board frame, of the sheet that `image` draws.

        In the picture's order: top left, top right, bottom right, bottom left.
        """
        low = -(1.0 + margin)
        right, bottom = self.columns + margin, self.rows + margin
        return self.square_m * np.array(
            [[low, low, 0.0], [right, low, 0.0], [right, bottom, 0.0], [low, bottom, 0.0]]
        )

    def image(self, pixels_per_square: int = 64, margin: float = 0.5) -> Image:
        """The print (height, width) uint8, black 0 and white 255, as it is seen from the front.

        `margin`: the white rim, in squares; with the squares' pixels it must give whole pixels.
        """
        rim = round(margin * pixels_per_square)
        if pixels_per_square < 1 or margin < 0 or abs(rim - margin * pixels_per_square) > 1e-9:
            raise OptionError(
                f"margin {margin} of squares {pixels_per_square} pixels wide: expected whole pixels"
            )
        size = (
            (self.rows + 1) * pixels_per_square + 2 * rim,
            (self.columns + 1) * pixels_per_square + 2 * rim,
        )
        if self.kind == "charuco":
            drawn = self._charuco.generateImage(size[::-1], marginSize=rim, borderBits=1)
            return np.asarray(drawn, np.uint8)
        row, column = np.mgrid[: self.rows + 1, : self.columns + 1]
        squares = np.where((row + column) % 2 == 0, 0, 255).astype(np.uint8)
        cell = np.ones((pixels_per_square, pixels_per_square), np.uint8)
        return np.pad(np.kron(squares, cell), rim, constant_values=255)

    def marker_cells(self) -> Array:
        """The markers' black cells, in rows: (n, 4), x0 y0 x1 y1, m, board frame."""
        if self.kind == "checkerboard":
            return np.zeros((0, 4))
        import cv2

        dictionary, boxes = self._charuco.getDictionary(), []
        cells = dictionary.markerSize + 2
        side = (self.marker_m or 0.0) / cells
        # OpenCV measures from the print's corner, a square before the first inner one.
        for number, corners in zip(
            self._charuco.getIds(), self._charuco.getObjPoints(), strict=True
        ):
            x, y = np.asarray(corners, float)[:, :2].min(axis=0) - self.square_m
            cell = cv2.aruco.generateImageMarker(dictionary, int(number), cells, borderBits=1) == 0
            for row, line in enumerate(np.pad(cell, ((0, 0), (1, 1))).astype(int)):
                step = np.diff(line)
                for a, b in zip(np.flatnonzero(step > 0), np.flatnonzero(step < 0), strict=True):
                    boxes.append((x + a * side, y + row * side, x + b * side, y + (row + 1) * side))
        return np.array(boxes)

    def detect(self, image: Image) -> tuple[NDArray[np.int64], Array]:
        """Ids (n,) and pixels (n, 2), (u, v), of the inner corners in an image uint8, grey or RGB.

        Id i is `corners()[i]`. A checkerboard is found whole or not at all (n = 0).
        """
        import cv2  # slow to import, so only where images are

        grey: Any = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if self.kind == "charuco":
            found, ids, markers, _ = self._detector.detectBoard(grey)
            if ids is None or len(ids) == 0:
                return np.zeros(0, np.int64), np.zeros((0, 2))
            ids = np.asarray(ids, np.int64).ravel()
            grid = np.full((self.rows, self.columns, 2), np.nan)
            grid.reshape(-1, 2)[ids] = found.reshape(-1, 2)
            return ids, _refined(self._without_markers(grey, markers), grid)[ids]
        size, thorough = (self.columns, self.rows), cv2.CALIB_CB_EXHAUSTIVE
        # Stretching the contrast finds some boards and loses others.
        for flags in (thorough, thorough | cv2.CALIB_CB_NORMALIZE_IMAGE):
            seen, found = cv2.findChessboardCornersSB(grey, size, flags=flags)
            if seen:
                grid = np.asarray(found, float).reshape(self.rows, self.columns, 2)
                return np.arange(len(found)), _refined(grey, _as_printed(grey, grid))
        return np.zeros(0, np.int64), np.zeros((0, 2))

    @cached_property
    def _charuco(self) -> Any:
        import cv2

        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(self.dictionary)))
        squares = (self.columns + 1, self.rows + 1)
        return cv2.aruco.CharucoBoard(squares, self.square_m, self.marker_m or 0.0, dictionary)

    @cached_property
    def _detector(self) -> Any:
        import cv2

        parameters = cv2.aruco.DetectorParameters()
        # With fewer a marker that is seen at a slant is misread now and then.
        parameters.perspectiveRemovePixelPerCell = 8
        return cv2.aruco.CharucoDetector(self._charuco, cv2.aruco.CharucoParameters(), parameters)

    def _without_markers(self, grey: Image, markers: Any) -> Image:
        """The image with the markers painted over in their squares' white: a checkerboard."""
        import cv2

        # Half way from a marker's edge to its square's; every corner that is found has both its
        # markers found.
        grow = 0.5 * (1.0 + self.square_m / (self.marker_m or 1.0))
        plain, limit = grey.copy(), np.array(grey.shape[::-1]) - 1
        for marker in markers:
            corner = marker.reshape(4, 2)
            quad = corner.mean(axis=0) + grow * (corner - corner.mean(axis=0))
            u, v = np.clip(np.rint(np.linspace(quad, np.roll(quad, -1, 0), 8)), 0, limit).T
            white = float(np.median(grey[v.astype(int), u.astype(int)]))
            cv2.fillConvexPoly(plain, np.rint(quad).astype(np.int32), white)
        return plain

    def _check_dictionary(self, name: str) -> None:
        import cv2

        names = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_") and n.isupper())
        if name not in names:
            raise OptionError(f"board dictionary {name!r}: expected one of {', '.join(names)}")
        size = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)
        needed = (self.columns + 1) * (self.rows + 1) // 2
        if size < needed:
            raise OptionError(
                f"board dictionary {name}: {size} markers, expected {needed} or more for"
                f" {self.columns} x {self.rows} inner corners"
            )


REACH = 0.45
"""Half width of the window round a corner, in distances to the next corner."""

LARGEST_WINDOW = 20
"""Pixels: a lens bends longer edges."""

BLUR = 0.1
"""Standard deviation of the blur before corners are refined, in half widths of the window.

The gradients that the refinement lives on are aliased where an image is as sharp as its pixels: on
exact renders the blur takes the corners' rms from 0.04 to 0.01 pixels."""


def _refined(grey: Image, grid: Array) -> Array:
    """Pixels (rows * columns, 2) of a grid (rows, columns, 2), NaN where no corner was found.

    Each moves to the point that all gradients around it are perpendicular to (Foerstner & Guelch
    1987).
    """
    import cv2

    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    spacing = np.concatenate(steps)
    pixels, seen = grid.reshape(-1, 2).copy(), np.isfinite(grid[..., 0]).ravel()
    if not np.isfinite(spacing).any():
        return pixels
    half = min(max(2, int(REACH * np.nanmin(spacing))), LARGEST_WINDOW)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), BLUR * half)
    start = pixels[seen].astype(np.float32).reshape(-1, 1, 2)
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    pixels[seen] = cv2.cornerSubPix(smooth, start, (half, half), (-1, -1), until).reshape(-1, 2)
    return pixels


def _as_printed(grey: Image, grid: Array) -> Array:
    """The grid (rows, columns, 2) turned so that it begins at the board's first corner."""
    along, down = np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]
    if (along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0]).mean() < 0.0:
        grid = grid[:, ::-1]
    middle = 0.25 * (grid[:-1, :-1] + grid[:-1, 1:] + grid[1:, :-1] + grid[1:, 1:])
    u, v = np.rint(middle).astype(int).transpose(2, 0, 1)
    shade = grey[np.clip(v, 0, grey.shape[0] - 1), np.clip(u, 0, grey.shape[1] - 1)].astype(float)
    row, column = np.mgrid[: shade.shape[0], : shade.shape[1]]
    first_is_black = ((shade - shade.mean()) * np.where((row + column) % 2 == 0, -1, 1)).sum() > 0
    return grid if first_is_black else grid[::-1, ::-1]
