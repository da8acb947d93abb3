"""Hand-eye calibration with a board, from corners and flange poses to a verdict and X."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import Camera
from depthba.errors import DatasetError, OptionError
from rig.hand_eye.board import opencv, park_martin
from rig.hand_eye.board.begin import Beginning, begin
from rig.hand_eye.board.estimate import Estimate, Stated, estimate
from rig.hand_eye.board.intrinsics import estimated
from rig.hand_eye.board.noise import Prior
from rig.hand_eye.board.observations import Mount, Observations
from rig.hand_eye.board.pnp import BoardPoses, board_poses
from rig.hand_eye.board.suspects import numbering, numbering_fault, renumbered, suspects
from rig.hand_eye.board.verdict import (
    CLOCK_MATTERS,
    Status,
    Tested,
    Verdict,
    camera_doubt,
    judge,
    tested_clock,
)
from rig.hand_eye.board.views import NextView, next_view
from rig.hand_eye.flanges import turned
from rig.hand_eye.record import Open

Array = NDArray[np.float64]

Intrinsics = Literal["prior", "fixed", "estimated"]

# What is believed of the camera: the focal length and the centre to a thousandth, of themselves and
# of the image's width, and square pixels.
FOCAL, ASPECT, CENTRE = 0.001, 0.0002, 0.001
# Of an estimated camera: nothing but that pixels are nearly square and lenses no wilder than this.
LENS = (1.0, 0.002, 0.1, 1.0, 1.0, 0.01, 0.01, 1.0)
# Of a joint's zero, rad.
ZERO = 0.0005
# How far a camera may be from the flange or, fixed, from the robot's base, m: what is believed
# where the motions leave it open.
REACH, REACH_FIXED = 0.3, 3.0
# A clock that is off by more than this, s, is no clock.
CLOCK = 1.0


@dataclass(frozen=True)
class BoardOptions:
    """How to calibrate with a board."""

    mount: Mount = "eye-in-hand"
    """What the camera is fixed to: eye-in-hand, the flange, with the board standing still;
    eye-to-hand, the world, with the board on the flange."""
    intrinsics: Intrinsics = "prior"
    """The camera's numbers: prior, those of dataset.json, known to 0.1 % or better, as the images
    have it; fixed, those exactly; estimated, from the images alone, with the lens's distortion."""
    robot_sigma: tuple[float, float] | None = None
    """How well the robot repeats a flange pose: standard deviations along and about each axis, m
    and degrees. None: found from the data, about 0.00005 m and 0.01 degrees."""
    joint_zeros: bool = True
    """Whether the joints' zeros may be off, where the arm and its joints are known."""

    def __post_init__(self) -> None:
        """OptionError for values that make no sense."""
        sigma = self.robot_sigma
        if sigma is not None and not all(np.isfinite(v) and v > 0 for v in sigma):
            raise OptionError(
                f"--robot-sigma {sigma[0]:g} {sigma[1]:g}: expected two numbers above 0, m and"
                " degrees"
            )


# Where nothing is stated of the robot, m and rad: a good one.
ROBOT = (0.00005, float(np.radians(0.01)))


@dataclass(frozen=True, eq=False)
class BoardHandEye:
    """A hand-eye transform from images of a board, how certain it is, and whether to rely on it."""

    status: Status
    reason: str
    """One sentence for people."""
    mount: Mount
    T: Array | None
    """(4, 4), T_flange_camera; eye-to-hand: T_base_camera. None: the data were refused."""
    covariance: Array | None
    """(6, 6), translation along the axes of the frame that T maps into, then rotation about them,
    m^2 and rad^2, left perturbation about the camera centre."""
    open: tuple[Open, ...]
    """Directions that the motions leave open."""
    turned: Array
    """(3,) rad, by how much the flange turned between poses (root mean square) about three axes,
    the largest first."""
    observations: Observations
    """N poses, their corners numbered alike."""
    P: Array
    """(N, 4, 4), T_camera_board of each picture alone."""
    estimate: Estimate | None
    """None: the data were refused before any."""
    verdict: Verdict | None
    clock: Tested | None
    """s, by which the camera's stamps are late; None: the flange stood, or nobody can tell."""
    clock_free: bool
    """Whether the clock was put right."""
    methods: dict[str, Array]
    """(4, 4) by name, the closed forms: Park-Martin as in the paper, weighed, and OpenCV's five."""
    next: NextView | None
    """The pose to add next."""
    notes: tuple[str, ...]
    """What else is worth knowing."""
    seconds: float

    @property
    def trusted(self) -> bool:
        """Whether the exit status is 0 (else 3: finished, but not to be trusted)."""
        return self.status == "converged"


def calibrate(
    observations: Observations,
    options: BoardOptions | None = None,
    square: float = 0.03,
    alike: bool = False,
) -> BoardHandEye:
    """Estimate X from corners and flange poses.

    Args:
        observations: 3 poses or more.
        options: how; the defaults where None.
        square: m, side of the board's squares, for people.
        alike: whether the board looks the same after half a turn, so that its numbering may begin
            at either end.

    Raises:
        DatasetError: fewer than 3 poses, or as many whose corners give a pose.
        OptionError: an option makes no sense.
    """
    options = options or BoardOptions()
    started = time.perf_counter()
    observations = replace(observations, mount=options.mount)
    if len(observations) < 3:
        raise DatasetError(
            f"{len(observations)} poses that see the board, expected 3 or more: two leave the"
            " camera's place open"
        )
    notes: list[str] = []
    if options.intrinsics == "estimated":
        observations = replace(observations, camera=estimated(observations))
    pictures = board_poses(observations)
    usable = np.isfinite(pictures.T_camera_board).all(axis=(1, 2))
    if usable.sum() < 3:
        raise DatasetError(
            f"the board's pose is found in {usable.sum()} frames, expected 3 or more"
        )
    if not usable.all():
        observations = observations.subset(np.flatnonzero(usable))
        pictures = board_poses(observations)
    G, P = observations.carrier, _upright(observations.carrier, pictures)
    numbered = numbering(G, P, observations.points)
    fault = numbering_fault(observations, numbered.labels)
    if fault and alike and not (numbered.labels > 1).any():
        observations, P = renumbered(observations, numbered.labels), numbered.P
        notes.append("the board looks the same after half a turn: numbered by the robot's turns")
        fault = ""
    beginning = begin(G, P)
    reasons = [fault] if fault else suspects(observations, P, beginning)
    size = turned(observations.T_base_flange)[0]
    if reasons:
        return BoardHandEye(
            "inconsistent", "; ".join(reasons), options.mount, None, None, (), size, observations,
            P, None, None, None, False, {}, None, tuple(notes), time.perf_counter() - started,
        )  # fmt: skip
    prior, stated = prior_of(options, observations), stated_of(options)
    found = estimate(observations, beginning, P, prior, stated)
    clock = tested_clock(found.solution)
    free = clock is not None and clock.off(CLOCK_MATTERS)
    if free and clock is not None:
        found = estimate(observations, beginning, P, replace(prior, clock=CLOCK), stated)
        clock = tested_clock(found.solution)
        assert clock is not None
        notes.append(
            f"the camera's stamps are {1e3 * clock.value:+.1f} ms off the robot's (sigma"
            f" {1e3 * clock.sigma:.1f}): this was put right"
        )
    if options.intrinsics == "prior":
        believed = found.solution.problem.prior
        doubt = camera_doubt(found.solution)
        narrowed = replace(believed, lens=tuple(doubt * sigma for sigma in believed.lens))
        found = estimate(observations, beginning, P, narrowed, stated)
        notes.append(f"by the images the camera's numbers are known to {100 * FOCAL * doubt:.2g} %")
    if observations.stamps is not None and observations.stamps_robot is not None:
        notes += _stamp_notes(observations)
    away = np.linalg.norm(P[:, :3, 3], axis=1)
    verdict = judge(found, square, float(np.median(away)), prior.reach)
    for out, what in ((found.dropped, "flange poses"), (found.spoilt, "corners")):
        if names := ", ".join(str(observations.ids[i]) for i in np.flatnonzero(out)):
            notes.append(f"left out, their {what} do not fit the rest: frames {names}")
    return BoardHandEye(
        status=verdict.status,
        reason=verdict.reason,
        mount=options.mount,
        T=None if verdict.status == "inconsistent" else found.X,
        covariance=None if verdict.status == "inconsistent" else verdict.covariance,
        open=verdict.open,
        turned=size,
        observations=observations,
        P=P,
        estimate=found,
        verdict=verdict,
        clock=clock,
        clock_free=free,
        methods=closed_forms(G, P),
        next=next_view(found.solution),
        notes=tuple(notes),
        seconds=time.perf_counter() - started,
    )


def prior_of(options: BoardOptions, observations: Observations) -> Prior:
    """Return what is believed of all that the poses share."""
    camera = observations.camera
    zero = ZERO if options.joint_zeros and observations.joints is not None else 0.0
    reach = REACH if options.mount == "eye-in-hand" else REACH_FIXED
    if options.intrinsics == "fixed":
        return Prior(reach, zero=zero)
    if options.intrinsics == "estimated":
        focal, aspect, centre, *distortion = LENS
        c = centre * camera.width
        return Prior(reach, (focal, aspect, c, c, *distortion), zero=zero)
    c = CENTRE * camera.width
    return Prior(reach, (FOCAL, ASPECT, c, c, 0.0, 0.0, 0.0, 0.0, 0.0), zero=zero)


def stated_of(options: BoardOptions) -> Stated:
    """Return what is stated of the robot."""
    if options.robot_sigma is None:
        return Stated(ROBOT, fixed=False)
    t, degrees = options.robot_sigma
    return Stated((t, float(np.radians(degrees))), fixed=True)


def closed_forms(G: Array, P: Array) -> dict[str, Array]:
    """Return X (4, 4) by every closed form; NaN where one fails."""
    m = park_martin.motions(G, P)
    found = {"park-martin": park_martin.park_martin(m), "weighed": park_martin.solve(m)}
    return found | {f"opencv {name.lower()}": opencv.solve(G, P, name) for name in opencv.METHODS}


def _upright(G: Array, pictures: BoardPoses) -> Array:
    """Return T_camera_board (N, 4, 4), of two poses of like error the one that fits the robot."""
    P = pictures.T_camera_board.copy()
    second = pictures.T_camera_board_second
    unsure = np.isfinite(second).all(axis=(1, 2)) & (
        pictures.rms[:, 1] < 1.5 * np.maximum(pictures.rms[:, 0], 1e-3)
    )
    if not unsure.any() or unsure.all():
        return P
    beginning: Beginning = begin(G[~unsure], P[~unsure]) if (~unsure).sum() >= 3 else begin(G, P)
    expected = se3.inverse(beginning.X) @ G @ beginning.Y
    for k in np.flatnonzero(unsure):
        one, other = (
            float(np.linalg.norm(se3.difference(T[k], expected[k])[3:])) for T in (P, second)
        )
        if other < one:
            P[k] = second[k]
    return P


def _stamp_notes(observations: Observations) -> list[str]:
    assert observations.stamps is not None and observations.stamps_robot is not None
    apart = observations.stamps - observations.stamps_robot
    went = np.linalg.norm(observations.speed[:, :3], axis=1) * np.abs(apart)
    if np.median(np.abs(apart)) < CLOCK_MATTERS:
        return []
    return [
        f"the robot was read {1e3 * np.median(apart):.0f} ms before the images (median); the flange"
        f" went up to {1e3 * went.max():.2f} mm in between"
    ]


def camera_found(result: BoardHandEye) -> Camera:
    """Return the camera as it is thought to be after the calibration."""
    if result.estimate is None:
        return result.observations.camera
    return result.estimate.solution.chain.camera(result.observations)
