"""Which of the wanted camera poses the arm can take, one after the other, and with which joints."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.kinematics import UR16E, DhArm
from depthba.postures import ROOM, SINGULAR, postures, turned_towards
from sim.engine import mujoco
from sim.errors import SimulationError
from sim.rigs.clearance import VIEW, Clearance
from sim.robots.ur16e import T_FLANGE_CAMERA

Array = NDArray[np.float64]

_BATCH = 8
"""Alternatives whose joints are searched for together."""

_REASONS = ("out of reach", "near a singularity", "in collision", "with the arm in view")
_PATH, _OVERLAP = "with the way there blocked", "with too little overlap"


@dataclass(frozen=True)
class Plan:
    """Poses of an arm in the order in which it takes them."""

    q: Array
    """(N, n) joints, rad."""
    T_world_camera: Array
    """(N, 4, 4) from these joints: the forward kinematics of the arm, not the wish."""
    T_world_base: Array
    """(4, 4)."""


def plan(
    model: mujoco.MjModel,
    wanted: Iterable[Array],
    count: int,
    *,
    arm: DhArm = UR16E,
    T_flange_camera: Array = T_FLANGE_CAMERA,
    overlap: float = 0.0,
    margin: float = 0.02,
    view: tuple[float, float] = VIEW,
) -> Plan:
    """Take the first `count` of the `wanted` camera poses that the arm in `model` can take in turn.

    `wanted` gives, in order of preference, poses T_world_camera (4, 4) or stacks of alternatives
    (m, 4, 4), of which at most one is taken. It may be endless only if enough of it can be had. A
    pose is taken if some joints reach it inside their limits and away from singularities, nothing
    comes closer to the arm than `margin` (m) there and on the straight joint path from the pose
    before, no part of the arm is in the camera's `view` cone (rad), and it shares at least
    `overlap` of its view of the plane z = 0 with the pose before, and that one with it.

    Nothing here is random. SimulationError says how many candidates failed for which reason.
    """
    search = _Search(model, arm, T_flange_camera, overlap, margin, view)
    for entry in wanted:
        search.take_one(np.asarray(entry, float).reshape(-1, 4, 4))
        if len(search.taken) == count:
            q = np.array(search.taken)
            return Plan(q, search.camera_at(q), search.T_world_base)
    raise SimulationError(
        f"the scene allows {len(search.taken)} of {count} poses: of {search.tried} candidates"
        f" {search.reasons()}; expected more room around the arm, or fewer frames"
    )


class _Search:
    """The poses taken so far, and why others were not."""

    def __init__(
        self,
        model: mujoco.MjModel,
        arm: DhArm,
        T_flange_camera: Array,
        overlap: float,
        margin: float,
        view: tuple[float, float],
    ) -> None:
        self._clearance = Clearance(model, arm.joints, margin, view)
        self._arm, self._T_flange_camera, self._view = arm, T_flange_camera, view
        self._T_camera_flange = se3.inverse(T_flange_camera)
        self._overlap = overlap
        self.T_world_base = self._clearance.T_world_base
        self._T_base_world = se3.inverse(self.T_world_base)
        self.taken: list[Array] = []
        self.tried = 0
        self._failed: Counter[str] = Counter()

    def camera_at(self, q: Array) -> Array:
        """T_world_camera (..., 4, 4)."""
        return np.asarray(self.T_world_base @ self._arm.forward(q) @ self._T_flange_camera)

    def reasons(self) -> str:
        """How many candidates failed for which reason."""
        known = (*_REASONS, _PATH, _OVERLAP)
        return (
            ", ".join(f"{self._failed[r]} {r}" for r in known if self._failed[r]) or "none failed"
        )

    def take_one(self, T_world_camera: Array) -> None:
        """Take the first of some alternatives (m, 4, 4) that can be had, if any."""
        left = np.arange(len(T_world_camera))
        if self.taken and self._overlap > 0.0:
            T_before = self.camera_at(self.taken[-1])
            near = shared_view(T_before, T_world_camera, self._view) >= self._overlap
            self.tried += int(np.sum(~near))
            self._failed[_OVERLAP] += int(np.sum(~near))
            left = left[near]
        for k in range(0, len(left), _BATCH):
            if self._take_first(T_world_camera[left[k : k + _BATCH]]):
                return

    def _take_first(self, T_world_camera: Array) -> bool:
        """Take the first of a batch (m, 4, 4) that can be had; False: none."""
        T_base_flange = self._T_base_world @ T_world_camera @ self._T_camera_flange
        last = self.taken[-1] if self.taken else None
        q, right = postures(self._arm, T_base_flange, last)
        for k in range(len(T_world_camera)):
            self.tried += 1
            reason = self._take(q[k][right[k]], T_world_camera[k])
            if reason is None:
                return True
            self._failed[reason] += 1
        return False

    def _take(self, q: Array, T_world_camera: Array) -> str | None:
        """Take one of the solutions (k, n), the nearest if any; else the furthest they came."""
        before = self.taken[-1] if self.taken else None
        if before is not None:
            q = self._arm.unwound(turned_towards(q, before))
        low, high = np.add(self._arm.lower, ROOM), np.subtract(self._arm.upper, ROOM)
        q = q[((q >= low) & (q <= high)).all(axis=-1)]
        if len(q) == 0:
            return _REASONS[0]
        q = q[self._arm.manipulability(q) >= SINGULAR]
        if len(q) == 0:
            return _REASONS[1]
        stage = 2
        for one in _by_distance(q, before):
            if not self._clearance.out_of_sight(one, T_world_camera):
                stage = max(stage, 3)
                continue
            if not self._clearance.free(one):
                continue
            if before is not None and not self._clearance.path_free(before, one):
                stage = 4
                continue
            self.taken.append(one)
            return None
        return (*_REASONS, _PATH)[stage]


def _by_distance(q: Array, before: Array | None) -> Iterator[Array]:
    """Solutions (k, n), each once, the one with the shortest way first."""
    distance = np.abs(q - (0.0 if before is None else before)).max(axis=-1)
    given: list[Array] = []
    for k in np.argsort(np.round(distance, 6), kind="stable"):
        if not any(np.abs(q[k] - other).max() < 1e-6 for other in given):
            given.append(q[k])
            yield q[k]


def shared_view(T_world_a: Array, T_world_b: Array, view: tuple[float, float] = VIEW) -> Array:
    """The share (...) of what one camera sees of the plane z = 0 that the other sees too.

    Poses (..., 4, 4); the lesser way. Of rays spread evenly over the view that meet the plane
    within 2 m.
    """
    ways = _seen_again(T_world_a, T_world_b, view), _seen_again(T_world_b, T_world_a, view)
    return np.minimum(*ways)


def _seen_again(T_world_a: Array, T_world_b: Array, view: tuple[float, float]) -> Array:
    half = np.tan(np.multiply(view, 0.5))
    x, y = np.meshgrid(np.linspace(-0.95, 0.95, 15) * half[0], np.linspace(-0.9, 0.9, 10) * half[1])
    p_camera = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rays = p_camera @ np.swapaxes(T_world_a[..., :3, :3], -1, -2)
    with np.errstate(divide="ignore"):
        depth = -T_world_a[..., 2, 3, None] / rays[..., 2]
    hit = (depth > 0.0) & (depth < 2.0)
    p_world = T_world_a[..., None, :3, 3] + rays * np.where(hit, depth, 0.0)[..., None]
    p_b = (p_world - T_world_b[..., None, :3, 3]) @ T_world_b[..., :3, :3]
    bound = half * np.maximum(p_b[..., 2:], 0.0)
    seen = hit & (p_b[..., 2] > 0.0) & (np.abs(p_b[..., :2]) <= bound).all(axis=-1)
    return np.asarray(seen.sum(axis=-1) / np.maximum(hit.sum(axis=-1), 1))
