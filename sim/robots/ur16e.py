"""A UR16e with a stereo camera on its flange, built from the arm's Denavit-Hartenberg parameters.

The body of joint i sits in DH frame i-1 and turns about its z, so that the joints' readings are
those of `depthba.kinematics.UR16E` and the base is the controller's "base" frame. The tubes follow
the arm's drawings in outline only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from depthba import se3
from depthba.kinematics import UR16E, DhArm
from depthba.ur_outline import FORE, HULLS, UPPER
from sim.engine import mujoco

Array = NDArray[np.float64]
Point = tuple[float, float, float]

BASE = "ur16e_base"
"""The body that stands on the table."""

LINKS = tuple(
    f"ur16e_{link}"
    for link in ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
)
CAMERA = "ur16e_camera"
"""The body of the camera; its frame is the left eye's, z forward."""

FLANGE = "flange"
"""The site of the flange."""

_R_FLANGE_CAMERA = se3.exp_so3([0.0, 0.0, np.radians(30.0)]) @ se3.exp_so3([np.radians(4.0), 0, 0])

T_FLANGE_CAMERA: Array = se3.make(
    _R_FLANGE_CAMERA, _R_FLANGE_CAMERA @ [-0.06, -0.06, 0.0] + [0.0, 0.0, 0.054]
)
"""Where the left eye sits: its bar is bolted beside the flange, 5 cm ahead of it, turned by 30
degrees about the flange's axis and leaning by 4."""
T_FLANGE_CAMERA.setflags(write=False)


@dataclass(frozen=True)
class _Shape:
    """A round piece from `start` to `end` in the frame of its body, m."""

    body: str
    start: Point
    end: Point
    radius: float
    finish: str = "tube"


@dataclass(frozen=True)
class _Mass:
    """A link's mass, spread as in a solid cylinder along one axis of its body, m."""

    kg: float
    centre: Point
    axis: int
    length: float
    radius: float


_FINISHES = {
    # rgba, specular, shininess
    "tube": ((0.50, 0.515, 0.53, 1.0), 0.3, 0.4),
    "cap": ((0.16, 0.33, 0.52, 1.0), 0.3, 0.3),
    "joint": ((0.10, 0.105, 0.115, 1.0), 0.2, 0.3),
    "bare": ((0.50, 0.51, 0.52, 1.0), 0.8, 0.6),
    "housing": ((0.045, 0.045, 0.05, 1.0), 0.3, 0.4),
    "glass": ((0.02, 0.022, 0.03, 1.0), 0.9, 0.9),
}

_A2, _A3 = UR16E.a[1], UR16E.a[2]
_D1, _D4, _D5, _D6 = UR16E.d[0], UR16E.d[3], UR16E.d[4], UR16E.d[5]
_SHOULDER_LINK, _UPPER_ARM, _FOREARM, _WRIST_1, _WRIST_2, _WRIST_3 = LINKS

_SHAPES = (
    _Shape(BASE, (0, 0, 0), (0, 0, 0.032), 0.095, "tube"),
    _Shape(BASE, (0, 0, 0.032), (0, 0, 0.092), 0.077, "tube"),
    _Shape(BASE, (0, 0, 0.092), (0, 0, 0.100), 0.074, "joint"),
    # The lift axis leaves the shoulder along -y.
    _Shape(_SHOULDER_LINK, (0, 0, 0.100), (0, 0, _D1 + 0.02), 0.076),
    _Shape(_SHOULDER_LINK, (0, 0.078, _D1), (0, -0.092, _D1), 0.076),
    _Shape(_SHOULDER_LINK, (0, 0.090, _D1), (0, 0.078, _D1), 0.069, "cap"),
    _Shape(_SHOULDER_LINK, (0, -0.092, _D1), (0, -0.099, _D1), 0.073, "joint"),
    _Shape(_UPPER_ARM, (0, 0, 0.099), (0, 0, 0.246), 0.076),
    _Shape(_UPPER_ARM, (0, 0, 0.246), (0, 0, 0.258), 0.069, "cap"),
    _Shape(_UPPER_ARM, (-0.06, 0, UPPER), (_A2 + 0.05, 0, UPPER), 0.057),
    _Shape(_UPPER_ARM, (-0.074, 0, UPPER), (-0.090, 0, UPPER), 0.0585, "joint"),
    _Shape(_UPPER_ARM, (_A2 + 0.080, 0, UPPER), (_A2 + 0.064, 0, UPPER), 0.0585, "joint"),
    _Shape(_UPPER_ARM, (_A2, 0, 0.108), (_A2, 0, 0.234), 0.063),
    _Shape(_UPPER_ARM, (_A2, 0, 0.234), (_A2, 0, 0.245), 0.057, "cap"),
    _Shape(_FOREARM, (0, 0, 0.108), (0, 0, 0.101), 0.060, "joint"),
    _Shape(_FOREARM, (0, 0, 0.101), (0, 0, -0.020), 0.062),
    _Shape(_FOREARM, (0, 0, -0.020), (0, 0, -0.031), 0.056, "cap"),
    _Shape(_FOREARM, (-0.05, 0, FORE), (_A3 + 0.03, 0, FORE), 0.046),
    _Shape(_FOREARM, (-0.060, 0, FORE), (-0.074, 0, FORE), 0.0475, "joint"),
    _Shape(_FOREARM, (_A3 + 0.060, 0, FORE), (_A3 + 0.046, 0, FORE), 0.0475, "joint"),
    _Shape(_FOREARM, (_A3, 0, -0.010), (_A3, 0, 0.092), 0.046),
    _Shape(_FOREARM, (_A3, 0, -0.010), (_A3, 0, -0.019), 0.041, "cap"),
    _Shape(_WRIST_1, (0, 0, 0.092), (0, 0, 0.099), 0.044, "joint"),
    _Shape(_WRIST_1, (0, 0, 0.099), (0, 0, 0.222), 0.046),
    _Shape(_WRIST_1, (0, 0, 0.222), (0, 0, 0.231), 0.041, "cap"),
    _Shape(_WRIST_1, (0, 0, _D4), (0, -0.062, _D4), 0.046),
    _Shape(_WRIST_2, (0, 0, 0.062), (0, 0, 0.069), 0.044, "joint"),
    _Shape(_WRIST_2, (0, 0, 0.069), (0, 0, 0.167), 0.046),
    _Shape(_WRIST_2, (0, 0, 0.167), (0, 0, 0.176), 0.041, "cap"),
    _Shape(_WRIST_2, (0, 0, _D5), (0, 0.066, _D5), 0.046),
    _Shape(_WRIST_3, (0, 0, 0.066), (0, 0, 0.073), 0.043, "joint"),
    _Shape(_WRIST_3, (0, 0, 0.073), (0, 0, _D6), 0.0375, "bare"),
)

_BAR = (0.175, 0.030, 0.033)
"""Width, height and depth of the ZED 2's bar, m (data sheet); its eyes lie 120 mm apart."""

_HULLS = (
    *(_Shape((BASE, *LINKS)[hull.link], hull.start, hull.end, hull.radius) for hull in HULLS),
    _Shape(CAMERA, (-0.0125, 0, -0.0185), (0.1325, 0, -0.0185), 0.028),
)
"""Capsules around the shapes, for collisions: every shape's rim lies inside one."""

_NEVER_MEET = (
    (BASE, _SHOULDER_LINK),
    (BASE, _UPPER_ARM),
    (_FOREARM, _WRIST_2),
    (_WRIST_1, _WRIST_3),
)
"""Links that the offsets between them keep apart by 1 to 3 cm at any angle: less than the capsules
add. MuJoCo leaves out neighbours by itself, but not those of a body that stands still."""

_MASSES = (
    _Mass(7.369, (0, 0, 0.16), 2, 0.2, 0.08),
    _Mass(10.45, (0.5 * _A2, 0, UPPER), 0, 0.55, 0.065),
    _Mass(4.321, (0.5 * _A3, 0, FORE), 0, 0.42, 0.05),
    _Mass(2.18, (0, 0, 0.15), 2, 0.13, 0.046),
    _Mass(2.033, (0, 0, 0.11), 2, 0.12, 0.046),
    _Mass(0.907, (0, 0, 0.09), 2, 0.05, 0.04),
)
"""The published masses; how they are spread is assumed."""
_CAMERA_MASS = _Mass(0.3, (0.06, 0.0, -0.02), 0, 0.175, 0.016)


def add_ur16e(
    spec: mujoco.MjSpec,
    T_world_base: ArrayLike | None = None,
    camera: bool = True,
    dh: DhArm = UR16E,
) -> None:
    """Add the arm to a scene, its base at `T_world_base` (4, 4), None: in the world's origin.

    Visible shapes are in group 2 and meet nothing; capsules in group 3 are what collides. `dh`
    may hold an arm's calibrated parameters; the shapes stay the nominal ones.
    """
    T = np.eye(4) if T_world_base is None else np.asarray(T_world_base, float)
    for name, (rgba, specular, shininess) in _FINISHES.items():
        spec.add_material(name=f"ur16e_{name}", rgba=rgba, specular=specular, shininess=shininess)
    bodies = {BASE: spec.worldbody.add_body(name=BASE, **_pose(T))}
    parent, step = bodies[BASE], np.eye(4)
    for i, (link, mass) in enumerate(zip(LINKS, _MASSES, strict=True)):
        parent = parent.add_body(name=link, gravcomp=1.0, **_pose(step), **_inertia(mass))
        parent.add_joint(
            name=dh.joints[i],
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0, 0, 1],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            range=np.degrees([dh.lower[i], dh.upper[i]])
            if spec.compiler.degree
            else [dh.lower[i], dh.upper[i]],
        )
        bodies[link], step = parent, dh.links()[i]
    parent.add_site(name=FLANGE, size=[0.002, 0.002, 0.002], group=5, **_pose(step))
    if camera:
        bodies[CAMERA] = _add_camera(parent, step)
    for shape in _SHAPES:
        _add_visible(bodies[shape.body], shape)
    for hull in _HULLS:
        if hull.body in bodies:
            bodies[hull.body].add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=[*hull.start, *hull.end],
                size=[hull.radius, 0.0, 0.0],
                group=3,
                rgba=[0.8, 0.2, 0.2, 0.4],
            )
    for one, other in _NEVER_MEET:
        spec.add_exclude(bodyname1=one, bodyname2=other)


def _add_camera(parent: mujoco.MjsBody, T_wrist_flange: Array) -> mujoco.MjsBody:
    """The stereo camera's bar and its bracket, all of it behind the eyes."""
    bracket = _pose(T_wrist_flange @ se3.make(_R_TURN, _R_TURN @ [0.0, -0.03, 0.004]))
    _add_box(parent, (0.035, 0.055, 0.004), bracket, "bare")
    body = parent.add_body(
        name=CAMERA,
        gravcomp=1.0,
        **_pose(T_wrist_flange @ T_FLANGE_CAMERA),
        **_inertia(_CAMERA_MASS),
    )
    width, height, depth = _BAR
    middle, back = 0.06, -0.002
    straight = 0.5 * (width - height)
    box = {"pos": [middle, 0.0, back - 0.5 * depth]}
    _add_box(body, (straight, 0.5 * height, 0.5 * depth), box, "housing")
    for end in (middle - straight, middle + straight):
        shape = _Shape(CAMERA, (end, 0, back - depth), (end, 0, back), 0.5 * height, "housing")
        _add_visible(body, shape)
    for eye in (0.0, 2.0 * middle):
        ring = _Shape(CAMERA, (eye, 0, back), (eye, 0, -0.001), 0.0105, "bare")
        _add_visible(body, ring)
        _add_visible(body, _Shape(CAMERA, (eye, 0, back), (eye, 0, -0.0005), 0.009, "glass"))
    foot = {"pos": [middle, 0.0, back - depth - 0.004]}
    _add_box(body, (0.03, 0.012, 0.004), foot, "bare")
    return body


_R_TURN = se3.exp_so3([0.0, 0.0, np.radians(30.0)])


def _pose(T: Array) -> dict[str, Array]:
    """A transform as MuJoCo takes it."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(T[:3, :3]).ravel())
    return {"pos": T[:3, 3].copy(), "quat": quaternion}


def _inertia(mass: _Mass) -> dict[str, object]:
    along = 0.5 * mass.kg * mass.radius**2
    across = mass.kg * (3.0 * mass.radius**2 + mass.length**2) / 12.0
    moments = [across] * 3
    moments[mass.axis] = along
    return {
        "explicitinertial": True,
        "mass": mass.kg,
        "ipos": list(mass.centre),
        "inertia": moments,
    }


def _add_visible(body: mujoco.MjsBody, shape: _Shape) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        fromto=[*shape.start, *shape.end],
        size=[shape.radius, 0.0, 0.0],
        **_look(shape.finish),
    )


def _add_box(body: mujoco.MjsBody, half: Point, pose: dict, finish: str) -> None:
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, **pose, **_look(finish))


def _look(finish: str) -> dict[str, object]:
    return {
        "material": f"ur16e_{finish}",
        "group": 2,
        "contype": 0,
        "conaffinity": 0,
        "mass": 0.0,
    }
