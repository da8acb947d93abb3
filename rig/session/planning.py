"""From what a session file asks for to joints in the order in which they are taken."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.camera import Camera
from depthba.errors import OptionError, OutOfReach
from depthba.postures import ROOM, SINGULAR, postures, turned_towards
from depthba.ur_outline import in_view
from rig.session.aims import (
    calibration_views,
    dome_poses,
    grid_poses,
    look_pose,
    step_positions,
)
from rig.session.options import Session
from rig.session.poses import Calibration, Look, Poses
from rig.session.reading import read_taught
from rig.session.workspace import Workspace

Array = NDArray[np.float64]

_BATCH = 64
_FEW = 4
"""Alternatives to a view that are looked at together: mostly the first will do."""


@dataclass(frozen=True, eq=False)
class Plan:
    """The stations of a session, in order."""

    joints: Array
    """(N, n) rad or m."""
    labels: tuple[str, ...]
    """Where each comes from, as "grid 3"."""
    T_world_camera: Array
    """(N, 4, 4), as believed."""
    left_out: tuple[tuple[str, str], ...] = ()
    """Label and reason of poses that cannot be taken."""
    length: float = 0.0
    """Sum of the longest joint's ways, rad or m."""


@dataclass(frozen=True, eq=False)
class _Wish:
    """A pose as asked for: joints (n,), or a T_base_flange (4, 4)."""

    label: str
    joints: Array | None = None
    T_base_flange: Array | None = None


def plan(
    session: Session, space: Workspace, start: Array, see: Callable[[], Camera] | None = None
) -> Plan:
    """Find joints for all poses, and an order in which the way is short.

    Args:
        session: what is asked for.
        space: where the rig may be.
        start: joints (n,) where the rig stands, or will stand, before the first.
        see: gives the camera's intrinsics; called once what needs none of them is known to be
            right. None: nobody looks whether the arm is in view; views of a board need it.

    Raises:
        OutOfReach: some poses cannot be taken, and the session does not leave them out; or none
            can. Says of each why.
        OptionError: poses of the wrong length; a file that cannot be read.
    """
    wishes = [
        replace(wish, label=f"{wish.label} of poses[{number}]") if len(session.poses) > 1 else wish
        for number, poses in enumerate(session.poses)
        if poses.calibration is None
        for wish in _wishes(poses, space)
    ]
    choices, refused = _choices(wishes, space, start)
    if refused and session.unreachable == "refuse":
        raise OutOfReach(_listed(refused, len(wishes)))
    if see is not None and space.body.arm is not None:
        camera = see()
        if session.limits.arm_in_view == "refuse":
            refused += _out_of_view(wishes, choices, space, camera)
        if refused and session.unreachable == "refuse":
            raise OutOfReach(_listed(refused, len(wishes)))
        for number, poses in enumerate(session.poses):
            if poses.calibration is not None:
                name = "calibration" + (f" of poses[{number}]" if len(session.poses) > 1 else "")
                views = _views(poses.calibration, session, space, start, camera)
                wishes += [_Wish(f"{name} {k}") for k in range(len(views))]
                choices += views
    elif session.board is not None:
        raise OptionError("poses: calibration: expected a camera that is known")
    able = [k for k in range(len(wishes)) if len(choices[k])]
    order = _ordered(able, choices, space, start, session.order == "given")
    taken = {k for k, _ in order}
    blocked = [
        (wishes[k].label, _no_way(choices[k][0], order, space, start))
        for k in able
        if k not in taken
    ]
    refused += blocked
    if (blocked and session.unreachable == "refuse") or not order:
        raise OutOfReach(_listed(refused, len(wishes)))
    if session.order == "shortest":
        order = _shortened(order, space, start)
    joints = np.array([q for _, q in order])
    return Plan(
        joints,
        tuple(wishes[k].label for k, _ in order),
        space.camera_at(joints),
        tuple(refused),
        _length(joints, start),
    )


def _out_of_view(
    wishes: list[_Wish], choices: list[Array], space: Workspace, camera: Camera
) -> list[tuple[str, str]]:
    """Take from the choices those with the arm in view; the wishes that lose their last one."""
    refused = []
    for k, wish in enumerate(wishes):
        parts = [_in_view(q, space, camera) for q in choices[k]]
        left = [row for row, part in enumerate(parts) if part is None]
        if parts and not left:
            refused.append((wish.label, _seen(parts[0])))
        choices[k] = choices[k][left]
    return refused


def _in_view(q: Array, space: Workspace, camera: Camera) -> str | None:
    arm = space.body.arm
    return None if arm is None else in_view(arm, q, space.T_flange_camera, camera)


def _seen(part: str | None) -> str:
    return (
        f"the arm's {part} stands in the camera's view, expected a view free of it (or"
        " limits.arm_in_view: allow)"
    )


def _views(
    aim: Calibration, session: Session, space: Workspace, start: Array, camera: Camera
) -> list[Array]:
    """Joints (k, n) of as many views of the board as are asked for; OutOfReach: of how many."""
    found: list[Array] = []
    reasons: Counter[str] = Counter()
    for T_world_camera in calibration_views(aim, camera):
        T = se3.inverse(space.T_world_base) @ T_world_camera @ se3.inverse(space.T_flange_camera)
        for first in range(0, len(T), _FEW):
            q, why = _first(T[first : first + _FEW], session, space, start, camera)
            if len(q):
                found.append(q)
                break
            reasons[why] += 1
        if len(found) == aim.count:
            return found
    most = "; ".join(f"{count} x {why}" for why, count in reasons.most_common(3))
    raise OutOfReach(
        f"{len(found)} of {aim.count} views of the board can be taken, expected all: move the"
        f" board to where the arm sees it from all sides, or widen the limits: {most}"
    )


def _first(
    T_base_flange: Array, session: Session, space: Workspace, start: Array, camera: Camera
) -> tuple[Array, str]:
    """Joints (k, n) of the first of some flanges (m, 4, 4) that can be had; else why not."""
    arm = space.body.arm
    assert arm is not None
    q, right = postures(arm, T_base_flange, start)
    why = ""
    for k in range(len(T_base_flange)):
        able, reason = _judged(q[k], right[k], space, start)
        why = why or (reason or "").partition(",")[0]
        if session.limits.arm_in_view == "refuse":
            free = [one for one in able if _in_view(one, space, camera) is None]
            why = why or ("the arm in view" if len(able) and not free else "")
            able = np.array(free).reshape(-1, q.shape[-1])
        # Where no way leads there from the start none may lead there at all.
        able = np.array([one for one in able if space.way(start, one)[1] is None])
        if len(able):
            return able, ""
        why = why or "no way there"
    return np.empty((0, q.shape[-1])), why


def _wishes(poses: Poses, space: Workspace) -> list[_Wish]:
    name, n = poses.given, len(space.body.names)
    if name in ("joints", "positions", "taught", "steps"):
        rows: Array | tuple[tuple[float, ...], ...]
        if poses.taught is not None:
            rows = read_taught(poses.taught.file, n, poses.taught.degrees)
        elif poses.steps is not None:
            rows = step_positions(poses.steps)
        else:
            rows = poses.joints or poses.positions or ()
        for number, row in enumerate(rows):
            if len(row) != n:
                raise OptionError(
                    f"poses: {name} {number}: {len(row)} numbers, expected {n}:"
                    f" {', '.join(space.body.names)}"
                )
        return [_Wish(f"{name} {k}", joints=np.array(row)) for k, row in enumerate(rows)]
    if poses.flange is not None:
        T_base_flange = np.array(poses.flange)
        if not se3.is_rigid(T_base_flange):
            raise OptionError("poses: flange: a pose is not rigid, expected rotations and places")
    else:
        T = _camera_poses(poses)
        if not se3.is_rigid(T):
            raise OptionError("poses: camera: a pose is not rigid, expected rotations and places")
        T_base_flange = se3.inverse(space.T_world_base) @ T @ se3.inverse(space.T_flange_camera)
    return [_Wish(f"{name} {k}", T_base_flange=T) for k, T in enumerate(T_base_flange)]


def _camera_poses(poses: Poses) -> Array:
    if poses.grid is not None:
        return grid_poses(poses.grid)
    if poses.dome is not None:
        return dome_poses(poses.dome)
    given = poses.camera or ()
    return np.array([look_pose(p) if isinstance(p, Look) else np.array(p) for p in given])


def _choices(
    wishes: list[_Wish], space: Workspace, start: Array
) -> tuple[list[Array], list[tuple[str, str]]]:
    """Joints (k, n) that each wish can be met with, and the wishes that cannot, with why."""
    found: list[Array] = [np.empty((0, len(start)))] * len(wishes)
    refused: list[tuple[str, str]] = []
    posed = [k for k, wish in enumerate(wishes) if wish.T_base_flange is not None]
    solved: dict[int, tuple[Array, NDArray[np.bool_]]] = {}
    arm = space.body.arm
    for first in range(0, len(posed), _BATCH):
        batch = posed[first : first + _BATCH]
        assert arm is not None
        q, right = postures(arm, np.array([wishes[k].T_base_flange for k in batch]), start)
        solved.update((k, (q[i], right[i])) for i, k in enumerate(batch))
    for k, wish in enumerate(wishes):
        if wish.joints is not None:
            reason = space.why_not(wish.joints)
            if reason is None:
                found[k] = wish.joints[None]
        else:
            found[k], reason = _judged(*solved[k], space, start)
        if reason is not None:
            refused.append((wish.label, reason))
    return found, refused


def _judged(
    q: Array, right: NDArray[np.bool_], space: Workspace, start: Array
) -> tuple[Array, str | None]:
    """What of the solutions (k, n) can be taken, each once; else why none."""
    arm, body = space.body.arm, space.body
    assert arm is not None
    q = turned_towards(q[right], start)
    if len(q) == 0:
        return q, "out of reach"
    q = arm.unwound(q)
    inside = ((q >= body.lower + ROOM) & (q <= body.upper - ROOM)).all(axis=-1)
    if not inside.any():
        return q[:0], f"out of reach within the joint limits ({ROOM:g} rad are kept from them)"
    q = q[inside]
    fitting = space.fitting(q)
    if not fitting.any():
        return q[:0], space.why_not(q[0])
    q = q[fitting]
    q = q[arm.manipulability(q) >= SINGULAR]
    if len(q) == 0:
        return q, "near a singularity"
    kept: list[Array] = []
    for one in q:
        if not any(np.abs(one - other).max() < 1e-6 for other in kept):
            kept.append(one)
    return np.array(kept), None


def _ordered(
    able: list[int], choices: list[Array], space: Workspace, start: Array, given: bool
) -> list[tuple[int, Array]]:
    """Wish and joints, one after the other: the nearest of those left, or as given."""
    left, here, order = list(able), start, []
    while left:
        options = [
            (float(np.abs(q - here).max()), k, q)
            for k in (left[:1] if given else left)
            for q in choices[k]
        ]
        options.sort(key=lambda option: option[:2])
        for _, k, q in options:
            if space.way(here, q)[1] is None:
                order.append((k, q))
                left.remove(k)
                here = q
                break
        else:
            if not given:
                break
            left.pop(0)
    return order


def _shortened(
    order: list[tuple[int, Array]], space: Workspace, start: Array
) -> list[tuple[int, Array]]:
    """The order with stretches of it turned round as long as that shortens the way.

    2-opt (Croes 1958); the joints stay.
    """
    order = list(order)
    q = np.array([start, *(q for _, q in order)])
    n = len(order)
    for _ in range(n):
        distance = np.abs(q[:, None] - q[None]).max(axis=-1)
        better = False
        for i in range(n - 1):
            for j in range(i + 2, n + 1):
                # The stretch i + 1 .. j, turned round; it ends the way where j is the last.
                gain = distance[i, i + 1] - distance[i, j]
                if j < n:
                    gain += distance[j, j + 1] - distance[i + 1, j + 1]
                if gain <= 1e-9:
                    continue
                turned = q[i + 1 : j + 1][::-1]
                legs = [q[i], *turned, *([q[j + 1]] if j < n else [])]
                pairs = itertools.pairwise(legs)
                if any(space.way(a, b)[1] is not None for a, b in pairs):
                    continue
                q[i + 1 : j + 1] = turned.copy()
                order[i:j] = order[i:j][::-1]
                distance = np.abs(q[:, None] - q[None]).max(axis=-1)
                better = True
        if not better:
            break
    return order


def _no_way(q: Array, order: list[tuple[int, Array]], space: Workspace, start: Array) -> str:
    here = order[-1][1] if order else start
    reason = space.way(here, q)[1] or "the way there leaves the limits"
    where = "where the rig stands" if not order else "the pose before"
    return f"no way from {where}: {reason}"


def _length(joints: Array, start: Array) -> float:
    legs = np.diff(np.concatenate([start[None], joints]), axis=0)
    return float(np.abs(legs).max(axis=1).sum())


def _listed(refused: list[tuple[str, str]], count: int) -> str:
    alike: dict[str, list[str]] = {}
    for label, reason in refused:
        alike.setdefault(reason, []).append(label)
    each = "; ".join(f"{', '.join(labels)}: {reason}" for reason, labels in alike.items())
    return (
        f"{len(refused)} of {count} poses cannot be taken, expected all of them"
        f" (or unreachable: leave out): {each}"
    )
