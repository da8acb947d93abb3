"""Which pose to add next: the view of the board that tells most about X."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from rig.hand_eye.board.chain import X
from rig.hand_eye.board.observations import Observations
from rig.hand_eye.board.refine import Solution, inverse_of, pixel_blocks

Array = NDArray[np.float64]

TILTS = np.radians([10.0, 25.0, 40.0])
AZIMUTHS = np.radians(np.arange(0.0, 360.0, 45.0))
TURNS = np.radians([-90.0, -45.0, 0.0, 45.0, 90.0])
# Distances as shares of the nearest and farthest that were used.
DISTANCES = (0.85, 1.0, 1.2)
# What stays free along the image's edges, as a share of its width and height.
MARGIN = 0.03
# How far beyond the reach and the region that was used a flange may be asked to go, m.
BEYOND = 0.1


@dataclass(frozen=True, eq=False)
class NextView:
    """A pose worth adding."""

    T_base_flange: Array
    """(4, 4)."""
    T_camera_board: Array
    """(4, 4)."""
    tilt: float
    """Angle between the line of sight and the board's normal, rad."""
    turn: float
    """About the line of sight, against the typical pose so far, rad."""
    distance: float
    """From the camera to the board's middle, m."""
    before: float
    after: float
    """Root mean square by which X's error displaces a point at the board, m, now and with this
    pose."""


def displacement(covariance: Array, distance: float) -> float:
    """Return by how much an uncertain X (6, 6) displaces points at a distance, m, rms."""
    t, r = np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])
    return float(np.sqrt(max(t, 0.0) + 2.0 / 3.0 * max(r, 0.0) * distance**2))


def next_view(solution: Solution) -> NextView | None:
    """Find the pose that reduces X's covariance most, of those that see the whole board.

    Each candidate's information, its own flange eliminated, is added to that of all poses; what
    counts is the displacement of a point at the board. None where no candidate fits.
    """
    problem, chain = solution.problem, solution.chain
    observations = problem.observations
    now = chain.T_camera_board(observations, problem.velocity)
    middle = 0.5 * (observations.points.min(axis=0) + observations.points.max(axis=0))
    away = np.linalg.norm(now[:, :3, :3] @ middle + now[:, :3, 3], axis=1)
    candidates = candidate_views(observations, now, middle, away)
    T = flanges(solution, candidates)
    fits, joints = reachable(observations, T)
    candidates, T = candidates[fits], T[fits]
    if len(T) == 0:
        return None
    information = candidate_information(solution, T, None if joints is None else joints[fits])
    S, _, _ = solution.normal.reduced()
    distance = float(np.median(away))
    after = [displacement(inverse_of(S + one)[X, X], distance) for one in information]
    best = int(np.argmin(after))
    P = candidates[best]
    eye = -P[:3, :3].T @ P[:3, 3] - middle
    usual = _typical(now)
    turned = P[:3, :3] @ usual.T
    return NextView(
        T_base_flange=T[best],
        T_camera_board=P,
        tilt=float(np.arccos(min(1.0, abs(eye[2]) / float(np.linalg.norm(eye))))),
        turn=float(np.arctan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1])),
        distance=float(np.linalg.norm(eye)),
        before=displacement(solution.covariance[X, X], distance),
        after=after[best],
    )


def candidate_views(observations: Observations, now: Array, middle: Array, away: Array) -> Array:
    """(C, 4, 4) T_camera_board, views about the typical one that hold the whole board.

    Args:
        observations: the board and the camera.
        now: (N, 4, 4), T_camera_board of the poses there are.
        middle: (3,), of the board, m.
        away: (N,), m, from the cameras to it.
    """
    usual = _typical(now)
    lean, azimuth, turn, share = (
        a.ravel() for a in np.meshgrid(TILTS, AZIMUTHS, TURNS, DISTANCES, indexing="ij")
    )
    reach = np.where(share < 1, share * away.min(), np.where(share > 1, share, 1.0) * away.mean())
    # the board faces the camera squarely in this frame, turned as it usually is
    normal = usual[:, 2]
    square = _onto(normal, np.array([0.0, 0.0, np.sign(normal[2])])) @ usual
    axis = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))], axis=-1)
    spin = se3.exp_so3(turn[:, None] * [0.0, 0.0, 1.0])
    R = spin @ se3.exp_so3(lean[:, None] * axis) @ square
    T = se3.make(R, reach[:, None] * [0.0, 0.0, 1.0] - R @ middle)
    points = np.einsum("cij,mj->cmi", R, observations.points) + T[:, None, :3, 3]
    camera = observations.camera
    pixels = camera.project(points)
    size = np.array([camera.width, camera.height])
    inside = (pixels >= MARGIN * size) & (pixels <= (1 - MARGIN) * size)
    return np.asarray(T[inside.all(axis=(1, 2))])


def flanges(solution: Solution, T_camera_board: Array) -> Array:
    """(C, 4, 4), T_base_flange that shows the camera the board so."""
    chain = solution.chain
    G = chain.X @ T_camera_board @ se3.inverse(chain.Y)
    if solution.problem.observations.mount == "eye-in-hand":
        return se3.inverse(G)
    return np.asarray(G)


def reachable(observations: Observations, T: Array) -> tuple[NDArray[np.bool_], Array | None]:
    """Tell which flanges (C, 4, 4) the arm can have, near the region that it is known to reach.

    Returns:
        (C,), whether; and how those flanges move with the joints (C, 6, n), where the arm is known.
    """
    known = observations.T_base_flange
    p, q = known[:, :3, 3], T[:, :3, 3]
    low, high = p.min(axis=0) - BEYOND, p.max(axis=0) + BEYOND
    within = ((q >= low) & (q <= high)).all(axis=1)
    within &= np.linalg.norm(q, axis=1) <= np.linalg.norm(p, axis=1).max()
    if observations.arm is None or observations.q is None:
        return np.asarray(within), None
    near = np.linalg.norm(q[:, None] - p, axis=-1).argmin(axis=1)
    joints, found = observations.arm.solve(T, observations.q[near], 1e-9)
    return np.asarray(within & found), observations.arm.jacobian(joints)


def candidate_information(solution: Solution, T: Array, joints: Array | None) -> Array:
    """(C, s, s), what each pose would add to the reduced matrix of what all poses share.

    Args:
        solution: so far.
        T: (C, 4, 4), the flanges.
        joints: (C, 6, n), how they move with the joints; None: the arm is not known.
    """
    problem = solution.problem
    observations = problem.observations
    count, points = len(T), observations.points
    if observations.joints is None:
        joints = None
    asked = Observations(
        T, points, np.zeros((count, len(points), 2)), observations.camera, observations.mount,
        joints=joints,
    )  # fmt: skip
    chain = replace(solution.chain, missed=np.zeros((count, 6)))
    weights = np.full((count, len(points)), 1 / problem.noise.corner**2)
    M = pixel_blocks(chain, asked, np.zeros((count, 6)), weights)
    s = chain.shared
    D = M[:, s : s + 6, s : s + 6] + np.diag(1 / problem.noise.flange())
    C = M[:, :s, s : s + 6]
    added = M[:, :s, :s] - C @ np.linalg.solve(D, np.swapaxes(C, -1, -2))
    held = ~solution.normal.free
    added[:, held], added[:, :, held] = 0.0, 0.0
    return np.asarray(added)


def _typical(T_camera_board: Array) -> Array:
    """(3, 3), the mean rotation."""
    u, _, vt = np.linalg.svd(T_camera_board[:, :3, :3].sum(axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _onto(a: Array, b: Array) -> Array:
    """(3, 3), the shortest rotation that takes unit vector a to b."""
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    return se3.exp_so3(np.arctan2(sine, float(a @ b)) * axis / sine)
