"""A calibration board on the arm's table: a print on a rigid plate that stands on three posts.

Board and posts stand elsewhere, turned and tilted otherwise, with every seed. What lies around is
too low to hide any of it.
"""

from __future__ import annotations

import json

import cv2
import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.boards import Board
from sim.calibration import NAME
from sim.engine import mujoco
from sim.scenes.arrangement import Bench, Part, Piece, Plot, Pose
from sim.scenes.machined import bolt, nut
from sim.scenes.solids import circle, extrude, rectangle
from sim.scenes.table import WORK_AREA, add_table
from sim.scenes.tools import calipers, hex_key, pliers, screwdriver, spanner
from sim.seeds import stream

Array = NDArray[np.float64]

PIXELS_PER_SQUARE = 64
"""Of the texture."""

_PAPER, _INK = 0.42, 0.03
"""Reflectance (linear): under lamp and sky the paper stays below white, so that no edge moves."""

_PLATE = 0.008
"""Thickness of the plate, m."""
_PRINT = 0.0002
"""The print's height above the plate, m."""
_POST = 0.008
"""Radius of a post, m."""
_CLEAR = 0.02
"""What stays under the plate's lowest corner, m."""
_LEAN = np.radians(20.0)
"""Most that the board leans, to any side, rad."""
_YAW = np.radians(20.0)
"""Standard deviation of its turn about the vertical, rad."""
_LOW, _AWAY = 0.035, 0.04
"""What lies around is lower than the one and stays as far from the board as the other, m."""


def handeye_board(seed: int) -> mujoco.MjSpec:
    """A checkerboard of 10 x 7 inner corners."""
    return _scene(seed, "handeye-board", Board())


def handeye_charuco(seed: int) -> mujoco.MjSpec:
    """The same with a ChArUco board."""
    return _scene(seed, "handeye-charuco", Board.charuco())


def _scene(seed: int, name: str, board: Board) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = name
    plot = add_table(spec, stream(seed, "handeye-board", "table"))
    rng = stream(seed, "handeye-board", "pose")
    lean, towards, yaw = (
        _LEAN * np.sqrt(rng.random()),
        rng.uniform(-np.pi, np.pi),
        rng.normal(0.0, _YAW),
    )
    at = np.array([rng.uniform(-0.12, 0.12), rng.uniform(0.54, 0.64)])
    # Lying flat a board is seen from above when its z points down.
    upright = se3.exp_so3([np.pi, 0.0, 0.0])
    leaning = se3.exp_so3(lean * np.array([np.cos(towards), np.sin(towards), 0.0]))
    R = leaning @ se3.exp_so3([0.0, 0.0, yaw]) @ upright
    sheet = board.sheet() @ R.T
    p_board = np.array([*(at - sheet.mean(axis=0)[:2]), _CLEAR + _PLATE - sheet[:, 2].min()])
    T_world_board = se3.make(R, p_board)
    _add_stand(plot.bench, T_world_board, board)
    add_print(spec, board, T_world_board)
    # Diffuse, as one would light it: the arm's shadow on the print would move corners.
    spec.worldbody.add_light(
        name="diffuse",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[0.0, 0.5, 3.0],
        dir=[0.55, -0.35, -0.76],
        castshadow=False,
    )
    _add_tools(plot.bench, p_board + sheet, stream(seed, "handeye-board", "pieces"))
    return spec


def add_print(spec: mujoco.MjSpec, board: Board, T_world_board: Array) -> None:
    """Put a board's print into a model: the textured sheet, and the text and site that tell of it.

    `T_world_board` (4, 4) is the frame of `depthba.boards`.
    """
    texture, file = "board", "board.png"
    spec.assets[file] = _png(board)
    spec.add_texture(
        name=texture,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        colorspace=mujoco.mjtColorSpace.mjCOLORSPACE_SRGB,
        file=file,
    )
    material = spec.add_material(
        name="print", rgba=[_PAPER, _PAPER, _PAPER, 1.0], specular=0.0, shininess=0.0
    )
    textures = list(material.textures)
    textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = texture
    material.textures = textures
    # In the order of the sheet's corners; its front is where z comes from.
    spec.add_mesh(
        name="print",
        uservert=board.sheet().ravel(),
        userface=[0, 3, 2, 0, 2, 1],
        usertexcoord=[0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 1.0],
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(T_world_board[:3, :3]).ravel())
    body = spec.worldbody.add_body(name=NAME, pos=T_world_board[:3, 3], quat=quaternion)
    body.add_geom(
        name="print",
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname="print",
        material="print",
        contype=0,
        conaffinity=0,
        mass=0.0,
    )
    body.add_site(name=NAME, size=[0.002, 0.002, 0.002], group=5)
    spec.add_text(name=NAME, data=json.dumps(board.json()))


def _png(board: Board) -> bytes:
    ink = round(255.0 * (1.055 * (_INK / _PAPER) ** (1.0 / 2.4) - 0.055))
    drawn = np.where(board.image(PIXELS_PER_SQUARE) > 0, 255, ink).astype(np.uint8)
    png: bytes = cv2.imencode(".png", drawn, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
    return png


def _add_stand(bench: Bench, T_world_board: Array, board: Board) -> None:
    """The plate under the print and its posts, on the table."""
    R, p_board = T_world_board[:3, :3], T_world_board[:3, 3]
    sheet = board.sheet()
    half, centre = 0.5 * np.ptp(sheet, axis=0), sheet.mean(axis=0)
    at = p_board + R @ centre
    here = R @ -centre + [0.0, 0.0, at[2]]
    plate = extrude(rectangle(half[0], half[1]), _PLATE, bottom=_PRINT)
    plate = plate.moved(centre.tolist()).moved(here.tolist(), R)
    parts = [Part(plate, (0.30, 0.31, 0.32), "painted")]
    for share in ((-0.8, 0.75), (0.8, 0.75), (0.0, -0.75)):
        # Where the plate's back is above a post, and a little further into the plate.
        back = here + R @ (centre + half * [*share, 0.0] + [0.0, 0.0, _PRINT + _PLATE])
        post = extrude(circle(_POST), float(back[2]) + 0.45 * _PLATE)
        parts.append(Part(post.moved((back[0], back[1], 0.0)), (0.05, 0.05, 0.055), "rubber"))
    bench.add(Piece("stand", tuple(parts)), Pose(float(at[0]), float(at[1])))


def _add_tools(bench: Bench, sheet: Array, rng: np.random.Generator) -> None:
    """Tools to the left and to the right of the board's sheet (4, 3), world frame."""
    x0, x1, y0, y1 = WORK_AREA
    sides = [(x0, sheet[:, 0].min() - _AWAY), (sheet[:, 0].max() + _AWAY, x1)]
    plots = [
        Plot(
            bench,
            (float(0.5 * (high - low)), 0.5 * (y1 - y0)),
            Pose(float(0.5 * (low + high)), 0.5 * (y0 + y1)),
            gap=0.02,
            height=_LOW,
        )
        for low, high in sides
    ]
    pieces = [maker(rng) for maker in (spanner, pliers, hex_key, calipers, screwdriver, spanner)]
    for _ in range(6):
        size = rng.uniform(0.010, 0.016)
        pieces += [nut(size), bolt(size, 3.2 * size)]
    for number, piece in enumerate(pieces):
        plots[number % 2].scatter(rng, piece)
