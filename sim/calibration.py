"""The calibration board of a scene, and what calibration.json says about it.

A model has a board if it has a text and a site called `board`: the text is the board's JSON (as in
calibration.json), the site stands in the board's frame as `depthba.boards` defines it.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.boards import Board
from depthba.errors import OptionError
from sim.engine import mujoco
from sim.errors import SimulationError
from sim.rigs.track import Track
from sim.robots.ur16e import BASE

Array = NDArray[np.float64]

NAME = "board"
"""Of the text and of the site."""


def board_of(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Board, Array] | None:
    """The model's board and T_world_board (4, 4); None where it has none.

    `data` must hold the forward kinematics. SimulationError for a text that is no board, and for
    one without a site.
    """
    text = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, NAME)
    if text < 0:
        return None
    start = int(model.text_adr[text])
    raw = bytes(model.text_data[start : start + int(model.text_size[text])]).rstrip(b"\0")
    try:
        board = Board.from_json(json.loads(raw))
    except (ValueError, OptionError) as error:
        raise SimulationError(
            f"the scene's text {NAME!r}: {error}; expected the JSON of a board"
        ) from error
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, NAME)
    if site < 0:
        raise SimulationError(f"the scene has a text {NAME!r}, expected a site of that name too")
    return board, se3.make(data.site_xmat[site].reshape(3, 3), data.site_xpos[site])


def of_model(model: mujoco.MjModel, data: mujoco.MjData, track: Track) -> dict[str, Any] | None:
    """What calibration.json holds: the board and the truth about it; None without a board.

    The base is the arm's, in a scene without it the world. `data` as for `board_of`.
    """
    found = board_of(model, data)
    if found is None:
        return None
    board, T_world_board = found
    T_world_base = np.eye(4)
    base = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, BASE)
    if base >= 0:
        T_world_base = se3.make(data.xmat[base].reshape(3, 3), data.xpos[base])
    calibration: dict[str, Any] = {"board": board.json()}
    if track.T_flange_camera_true is not None:
        calibration["T_flange_camera_true"] = track.T_flange_camera_true
    calibration["T_base_board_true"] = se3.inverse(T_world_base) @ T_world_board
    return calibration
