"""What a session file may say of where the camera is to stand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from depthba.boards import Board
from depthba.errors import OptionError

Row = tuple[float, float, float, float]
Matrix = Annotated[tuple[Row, Row, Row, Row], "a 4x4 (four rows of four numbers, m)"]
Point = tuple[float, float, float]
Pair = tuple[float, float]


@dataclass(frozen=True)
class Look:
    """A camera pose by where it stands and what it looks at.

    The image's x lies as it does when the camera looks straight down and is then turned the
    shortest way.
    """

    at: Point
    """World, m."""
    towards: Point
    """World, m."""
    roll_deg: float = 0.0
    """About the view."""

    def __post_init__(self) -> None:
        """OptionError: it looks nowhere."""
        if np.allclose(self.at, self.towards, atol=1e-6):
            raise OptionError(f"at {self.at} and towards are one point, expected two")


@dataclass(frozen=True)
class Grid:
    """Gaze points in rows over an area of a plane, each seen from above."""

    x: Pair
    y: Pair
    """First and last gaze point, world, m."""
    counts: tuple[int, int]
    """Along x and along y."""
    distance: float | Pair
    """From the gaze point to the camera, m; of two, every other frame has the other."""
    z: float = 0.0
    """Height of the gaze points, world, m."""
    tilt_deg: float = 0.0
    """By which the camera looks away from straight down; to another side from frame to frame."""
    roll_deg: float = 0.0
    """By which the image turns, to the one and the other side in turn."""
    yaw_deg: float = 0.0
    """By which all images are turned about the vertical."""

    def __post_init__(self) -> None:
        """OptionError names a value that makes no sense."""
        if min(self.counts) < 1:
            raise OptionError(f"counts {list(self.counts)}: expected 1 or more each")
        if np.min(self.distance) <= 0.0:
            raise OptionError(f"distance {self.distance}: expected above 0, m")
        if not 0.0 <= self.tilt_deg < 90.0:
            raise OptionError(f"tilt_deg {self.tilt_deg}: expected 0 to below 90")


@dataclass(frozen=True)
class Dome:
    """Rings of cameras on a sphere around a point, all of which look at it."""

    centre: Point
    """World, m."""
    radius: float
    """m."""
    tilts_deg: tuple[float, ...]
    """Of each ring, from straight above."""
    counts: tuple[int, ...]
    """Cameras of each ring."""
    first_deg: float = 0.0
    """Azimuth of a ring's first camera, from world x."""
    roll_deg: float = 0.0
    """By which the image turns, to the one and the other side in turn."""

    def __post_init__(self) -> None:
        """OptionError names a value that makes no sense."""
        if self.radius <= 0.0:
            raise OptionError(f"radius {self.radius}: expected above 0, m")
        if not self.counts or len(self.counts) != len(self.tilts_deg) or min(self.counts) < 1:
            raise OptionError(
                f"counts {list(self.counts)}: expected one of 1 or more for each of the"
                f" {len(self.tilts_deg)} tilts_deg"
            )
        if min(self.tilts_deg) < 0.0 or max(self.tilts_deg) >= 180.0:
            raise OptionError(f"tilts_deg {list(self.tilts_deg)}: expected 0 to below 180")


@dataclass(frozen=True)
class Taught:
    """Poses that somebody drove to: a text file, a line of joints (rad) or positions (m) each."""

    file: Path
    """Numbers with blanks or commas between them; # begins a comment."""
    degrees: bool = False
    """The joints are in degrees."""


@dataclass(frozen=True)
class Steps:
    """Positions of a gantry, evenly between two corners."""

    first: tuple[float, ...]
    last: tuple[float, ...]
    """m, an entry for each axis."""
    counts: tuple[int, ...]
    """Along each axis."""

    def __post_init__(self) -> None:
        """OptionError: the three do not belong together."""
        if not len(self.first) == len(self.last) == len(self.counts):
            raise OptionError(
                "first, last and counts: expected an entry for each axis in all three"
            )
        if not self.counts or min(self.counts) < 1:
            raise OptionError(f"counts {list(self.counts)}: expected 1 or more each")


@dataclass(frozen=True)
class Calibration:
    """Views of a calibration board that tell where the camera sits: near, far, tilted and turned.

    The board need only be where it is said to be to within `slack`.
    """

    board: str
    """Inner corners along x and y and the side of a square, m: 10x7x0.03 or charuco:10x7x0.03."""
    at: Point
    """The middle of the board, world, m."""
    facing: Point = (0.0, 0.0, 1.0)
    """Where its printed side looks, world."""
    turn_deg: float = 0.0
    """By which its x, along the columns, is turned about `facing`; 0: along world x as nearly as
    the board lies."""
    count: int = 20
    distance: Pair = (0.35, 0.60)
    """Least and largest from the camera to the board's middle, m; further off where the whole
    board must fit the image."""
    tilt_deg: Pair = (6.0, 40.0)
    """Least and largest angle between `facing` and the way to the camera."""
    roll_deg: float = 60.0
    """Largest turn about the line of sight, to either side."""
    slack: float = 0.02
    """How far the board may be from there, m: so much beside it stays in the image."""
    seed: int = 0
    """Of the views: another one gives others."""

    def __post_init__(self) -> None:
        """OptionError names a value that makes no sense."""
        Board.parse(self.board)
        if self.count < 3:
            raise OptionError(f"count {self.count}: expected 3 or more, better 15 to 20")
        if np.linalg.norm(self.facing) < 1e-9:
            raise OptionError(f"facing {self.facing}: expected a direction with a length")
        if not 0.0 < self.distance[0] <= self.distance[1]:
            raise OptionError(f"distance {list(self.distance)}: expected least and largest, m")
        if not 0.0 <= self.tilt_deg[0] <= self.tilt_deg[1] < 80.0:
            raise OptionError(
                f"tilt_deg {list(self.tilt_deg)}: expected least and largest, 0 to below 80"
            )
        if self.slack < 0.0 or self.seed < 0:
            raise OptionError(f"slack {self.slack}, seed {self.seed}: expected 0 or more")


@dataclass(frozen=True)
class Poses:
    """One way to say poses; give exactly one."""

    joints: tuple[tuple[float, ...], ...] | None = None
    """Of an arm, rad."""
    flange: tuple[Matrix, ...] | None = None
    """T_base_flange of an arm."""
    camera: tuple[Matrix | Look, ...] | None = None
    """T_world_camera, for an arm."""
    grid: Grid | None = None
    dome: Dome | None = None
    calibration: Calibration | None = None
    """Views of a board for `depthba calibrate`, for an arm."""
    taught: Taught | None = None
    positions: tuple[tuple[float, ...], ...] | None = None
    """Of a gantry, m."""
    steps: Steps | None = None

    def __post_init__(self) -> None:
        """OptionError: none is given, or two."""
        given = [name for name in self.__dataclass_fields__ if getattr(self, name) is not None]
        if len(given) != 1:
            raise OptionError(
                f"{' and '.join(given) or 'nothing'} given, expected one of:"
                f" {', '.join(self.__dataclass_fields__)}"
            )

    @property
    def given(self) -> str:
        """Which it is."""
        return next(name for name in self.__dataclass_fields__ if getattr(self, name) is not None)
