"""From a dataset's colour images to the corners of the board."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.boards import Board
from depthba.dataset import Dataset
from depthba.errors import DatasetError, OptionError
from rig.hand_eye.board.observations import FEWEST_CORNERS, Mount, Observations
from rig.hand_eye.flanges import flange_poses, known_arm

Array = NDArray[np.float64]

# A board whose shortest side is longer than this, m, was stated in another unit, and so was one
# whose squares are smaller.
LONGEST, SHORTEST = 3.0, 0.001
# Frames farther apart than this, s, say nothing about how fast the flange was.
APART = 0.5


@dataclass(frozen=True, eq=False)
class Detected:
    """What was found in the images."""

    observations: Observations
    """Of the frames that show the board."""
    rows: tuple[int, ...]
    """Their positions in the dataset."""
    without: tuple[int, ...]
    """Ids of the frames in which no board was found."""


def board_of(dataset: Dataset, text: str | None) -> Board:
    """Return the board that the words, or else calibration.json, speak of.

    Raises:
        OptionError: neither does, or it is no board.
    """
    if text is not None:
        board = Board.parse(text)
    else:
        calibration = dataset.calibration()
        if calibration is None or calibration.get("board") is None:
            raise OptionError(
                f"{dataset.path}: calibration.json names no board, expected it there or --board,"
                " as 10x7x0.03; --from-depth does without"
            )
        board = Board.from_json(calibration["board"])
    if not SHORTEST <= board.square_m <= LONGEST / min(board.columns, board.rows):
        raise OptionError(
            f"board square_m {board.square_m:g}: expected metres, such as 0.03 for squares of 30 mm"
        )
    return board


def detect(
    dataset: Dataset,
    board: Board,
    mount: Mount = "eye-in-hand",
    report: Callable[[int, int], None] | None = None,
) -> Detected:
    """Find the board in every image.

    Args:
        dataset: with colour images and flange poses.
        board: what to look for.
        mount: what the camera is fixed to.
        report: called before each image with how many are done and how many there are.

    Raises:
        DatasetError: there are no images, no flange poses, or fewer than 3 frames show the board.
    """
    camera = dataset.sensor.camera
    if camera is None:
        raise DatasetError(
            f"{dataset.path}: a sensor of kind 'cloud' has no images, expected colour images of the"
            " board"
        )
    T_base_flange = flange_poses(dataset)
    points = board.corners()
    pixels = np.full((len(dataset), len(points), 2), np.nan)
    seen = np.zeros(len(dataset), bool)
    for row, frame in enumerate(dataset):
        if report is not None:
            report(row, len(dataset))
        image = frame.rgb()
        if image is None:
            raise DatasetError(
                f"{dataset.path}: frame {frame.id} has no colour image, expected one that shows the"
                " board; --from-depth does without"
            )
        ids, found = board.detect(image)
        pixels[row, ids] = found
        seen[row] = len(ids) >= FEWEST_CORNERS
    rows = np.flatnonzero(seen)
    without = tuple(dataset[int(row)].id for row in np.flatnonzero(~seen))
    if len(rows) < 3:
        raise DatasetError(
            f"{dataset.path}: {len(rows)} of {len(dataset)} frames show the board of"
            f" {board.columns} x {board.rows} inner corners, expected 3 or more"
        )
    arm, q = known_arm(dataset, T_base_flange) or (None, None)
    robot = [frame.record.get("stamp_robot") for frame in dataset]
    known = all(isinstance(stamp, int | float) for stamp in robot)
    observations = Observations(
        T_base_flange,
        points,
        pixels,
        camera,
        mount,
        ids=dataset.ids,
        stamps=dataset.stamps,
        stamps_robot=np.array(robot, float) if known else None,
        joints=None if arm is None or q is None else arm.jacobian(q),
        arm=arm,
        q=q,
        velocity=velocities(T_base_flange, dataset.stamps),
    )
    return Detected(observations.subset(rows), tuple(int(r) for r in rows), without)


def velocities(T: Array, stamps: Array) -> Array:
    """(N, 6), m/s and rad/s, base axes: how fast flanges (N, 4, 4) went at stamps (N,), s.

    By central differences; 0 where the neighbours are too far away to tell, as in a capture that
    stops for each frame.
    """
    velocity = np.zeros((len(T), 6))
    gap = np.diff(stamps)
    near = (gap > 0) & (gap <= APART)
    inner = np.flatnonzero(near[:-1] & near[1:]) + 1
    if len(inner) == 0:
        return velocity
    before, here, after = T[inner - 1], T[inner], T[inner + 1]
    h0, h1 = gap[inner - 1][:, None], gap[inner][:, None]
    # of the parabola through three poses
    forth, back = se3.difference(after, here), se3.difference(before, here)
    velocity[inner] = (h0 * forth / h1 - h1 * back / h0) / (h0 + h1)
    return velocity
