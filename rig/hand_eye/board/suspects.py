"""What may be wrong with poses and corners as a whole, found before any number is believed.

Each suspect is a change to the input that would make it fit where, as given, it does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from rig.hand_eye.board import park_martin
from rig.hand_eye.board.begin import Beginning, begin, pose_misfit
from rig.hand_eye.board.observations import Mount, Observations
from rig.hand_eye.flanges import STILL, turned

Array = NDArray[np.float64]

# Closures (medians) beyond these, m and rad, are more than a poor robot and a poor camera make.
HOPELESS_T, HOPELESS_R = 0.01, 0.025
# A suspect is named when it makes the rotations close this many times better.
BETTER = 4.0
# Lengths that differ by more than this factor are in other units; by more than this share the board
# is of another size.
UNITS, SIZE = 5.0, 0.1


def _rotated(T: Array, turn: Callable[[Array], Array]) -> Array:
    return se3.make(se3.exp_so3(turn(se3.log_so3(T[:, :3, :3]))), T[:, :3, 3])


def _quaternions(T: Array, shift: int) -> Array:
    return se3.from_quaternion(T[:, :3, 3], np.roll(se3.quaternion(T), shift, axis=1))


def _fixed_camera(mount: Mount) -> str:
    if mount == "eye-in-hand":
        return (
            "the flange poses fit the other way round: they are T_flange_base where T_base_flange "
            "is expected, or the camera is fixed and the board on the flange (--mount eye-to-hand)"
        )
    return (
        "the flange poses fit the other way round: they are T_flange_base where T_base_flange is "
        "expected, or the camera is on the flange after all (--mount eye-in-hand)"
    )


CHANGES: tuple[tuple[str, Callable[[Array], Array]], ...] = (
    ("", se3.inverse),
    (
        "the flange rotations are transposed",
        lambda T: se3.make(np.swapaxes(T[:, :3, :3], -1, -2), T[:, :3, 3]),
    ),
    (
        "the flange rotations are in degrees where radians are expected",
        lambda T: _rotated(T, np.radians),
    ),
    (
        "the flange rotations are in radians, read as degrees",
        lambda T: _rotated(T, np.degrees),
    ),
    ("the flange quaternions were read w x y z for x y z w", lambda T: _quaternions(T, -1)),
    ("the flange quaternions were read x y z w for w x y z", lambda T: _quaternions(T, 1)),
)
"""What people do to flange poses, and how to undo it (N, 4, 4)."""


def suspects(observations: Observations, P: Array, beginning: Beginning) -> list[str]:
    """Say what is wrong; empty where the poses close as they should.

    Args:
        observations: N poses.
        P: (N, 4, 4), T_camera_board.
        beginning: how they close as given.
    """
    G = observations.carrier
    found, in_hand = [], observations.mount == "eye-in-hand"
    off_t, off_r = beginning.typical
    if off_r > HOPELESS_R:
        robot, camera = (
            np.degrees(turned(T)[0][0]) for T in (observations.T_base_flange, se3.inverse(P))
        )
        closings = []
        for _, change in CHANGES:
            T = change(observations.T_base_flange)
            closings.append(begin(se3.inverse(T) if in_hand else T, P).typical)
        # rotations decide; of several that close them, positions
        fitting = [k for k, c in enumerate(closings) if c[1] < off_r / BETTER]
        if fitting:
            best = min(fitting, key=lambda k: closings[k][0] + closings[k][1])
            found.append(CHANGES[best][0] or _fixed_camera(observations.mount))
        else:
            found.append(
                f"the robot's turns ({robot:.1f} degrees, rms) and the camera's ({camera:.1f}) do "
                f"not belong together: they miss each other by {np.degrees(off_r):.1f} degrees "
                "(median); expected T_base_flange of the very moment of each image, rotations in "
                "radians"
            )
        return found
    scale = camera_scale(G, P, beginning)
    if scale is not None:
        found.append(scale)
    elif off_t > HOPELESS_T:
        found.append(
            f"the poses do not close: the board seems to jump by {1e3 * off_t:.0f} mm (median), "
            "expected a board that stands still and poses of the very moment of each image"
        )
    return found


def camera_scale(G: Array, P: Array, beginning: Beginning) -> str | None:
    """Say by how much the camera's lengths and the robot's differ, where they plainly do."""
    good = beginning.good
    m = park_martin.motions(G[good], P[good])
    R = beginning.X[:3, :3]
    if turned(se3.inverse(G[good]))[0][1] < STILL:
        return _shift_scale(m, R)
    t, scale = park_martin.solve_translation(m.A, m.B, R, scale=True)
    misfit = np.einsum("kij,j->ki", m.A[:, :3, :3] - np.eye(3), t) + m.A[:, :3, 3]
    size = np.median(np.linalg.norm(misfit - scale * m.B[:, :3, 3] @ R.T, axis=1))
    plain, _ = park_martin.solve_translation(m.A, m.B, R)
    before = np.einsum("kij,j->ki", m.A[:, :3, :3] - np.eye(3), plain) + m.A[:, :3, 3]
    worse = np.median(np.linalg.norm(before - m.B[:, :3, 3] @ R.T, axis=1))
    if not size < worse / BETTER:
        return None
    return _said_of(scale)


def _shift_scale(m: park_martin.Motions, R: Array) -> str | None:
    """The same where nothing turned enough: shifts of the robot over shifts of the board."""
    robot, camera = m.A[:, :3, 3], m.B[:, :3, 3] @ R.T
    scale = float((robot * camera).sum() / max(float(np.square(camera).sum()), 1e-300))
    return _said_of(scale)


def _said_of(scale: float) -> str | None:
    if scale < 0:
        return "the images are mirrored: the board moves to the left where it should to the right"
    if abs(scale - 1) <= SIZE:
        return None
    if scale > UNITS:
        unit = " (millimetres?)" if 300 < scale < 3000 else ""
        return (
            f"lengths of the robot are {scale:.3g} times those of the camera: flange positions are "
            f"not in metres{unit}, or the board's squares are stated too small"
        )
    if scale < 1 / UNITS:
        unit = " (in millimetres?)" if 1 / 3000 < scale < 1 / 300 else ""
        return (
            f"lengths of the camera are {1 / scale:.3g} times those of the robot: the board's "
            f"squares are stated too large{unit}, or flange positions are not in metres"
        )
    return (
        f"by the robot the board is {scale:.3f} times as large as stated: measure its squares, and "
        "check the camera's focal length"
    )


@dataclass(frozen=True, eq=False)
class Numbering:
    """How the corners are numbered in each image."""

    P: Array
    """(N, 4, 4), T_camera_board with the numbering put right."""
    labels: NDArray[np.int64]
    """(N,), 0 as found, 1 from the other end (half a turn), 2 and 3 mirrored."""


def symmetries(points: Array) -> Array:
    """(4, 4, 4), what takes the board onto itself: nothing, half turns about z, x and y."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    turns = np.array([[1, 1, 1], [-1, -1, 1], [1, -1, -1], [-1, 1, -1]], float)
    R = np.einsum("kj,ij->kij", turns, np.eye(3))
    return se3.make(R, centre - R @ centre)


def numbering(G: Array, P: Array, points: Array) -> Numbering:
    """Find the numbering of each image with which the camera turns as the robot does.

    Every image in turn is taken as the one that is right; the best of these choices counts. All
    images renumbered alike would be no change but to the board's frame.
    """
    S = symmetries(points)
    n = len(P)
    R_P = np.einsum("nab,kbc->nkac", P[:, :3, :3], S[:, :3, :3])
    R_A = np.einsum("iab,jcb->ijac", G[:, :3, :3], G[:, :3, :3])
    robot = np.linalg.norm(se3.log_so3(R_A), axis=-1)
    R_B = np.einsum("ikab,jcb->ijkac", R_P, P[:, :3, :3])
    misfit = np.abs(robot[..., None] - np.linalg.norm(se3.log_so3(R_B), axis=-1))  # (i, j, label)
    best, labels = np.inf, np.zeros(n, np.int64)
    for reference in range(n):
        chosen = np.argmin(misfit[:, reference], axis=1)
        # half turns commute, so labels of two images give one between them
        between = misfit[np.arange(n)[:, None], np.arange(n), _product(chosen)]
        score = float(np.median(pose_misfit(between))) if n > 2 else 0.0
        if score < 0.5 * best:
            best, labels = score, chosen
    counts = np.bincount(labels, minlength=4)
    labels = _product(labels)[:, int(np.flatnonzero(labels == np.argmax(counts))[0])]
    plain = pose_misfit(misfit[..., 0])
    settled = pose_misfit(misfit[np.arange(n)[:, None], np.arange(n), _product(labels)])
    # only what makes an image fit that did not, and only where that makes most of them fit
    keep = (settled < plain / BETTER) & (plain > HOPELESS_R)
    keep &= float(np.median(settled)) < HOPELESS_R
    labels = np.where(keep, labels, 0)
    return Numbering(np.einsum("nij,njk->nik", P, S[labels]), labels)


def _product(labels: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N, N), the labels between images: Klein's four-group, whose product is exclusive or."""
    return labels[:, None] ^ labels[None, :]


def renumbered(observations: Observations, labels: NDArray[np.int64]) -> Observations:
    """Return the observations with the corners of each image (N,) numbered as the labels say."""
    S = symmetries(observations.points)
    pixels = observations.pixels.copy()
    for label in (1, 2, 3):
        onto = observations.points @ S[label, :3, :3].T + S[label, :3, 3]
        apart = np.linalg.norm(onto[:, None] - observations.points, axis=-1)
        order = np.argmin(apart, axis=1)
        rows = np.flatnonzero(labels == label)
        pixels[rows] = observations.pixels[rows][:, order]
    return replace(observations, pixels=pixels)


def numbering_fault(observations: Observations, labels: NDArray[np.int64]) -> str:
    """Say which images number their corners otherwise; empty where none does."""
    if not labels.any():
        return ""
    names = ", ".join(str(observations.ids[i]) for i in np.flatnonzero(labels))
    how = "mirrored" if (labels > 1).any() else "from the other end of the board"
    return f"the corners of frames {names} are numbered {how}, expected one order in all frames"
