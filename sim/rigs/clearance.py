"""Whether the arm stands free: of the scene, of itself, and out of its camera's sight."""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from sim.engine import mujoco
from sim.errors import SimulationError
from sim.robots.ur16e import BASE, CAMERA, LINKS

Array = NDArray[np.float64]

VIEW = (float(np.radians(100.0)), float(np.radians(68.0)))
"""Width and height of the ZED 2's view cone, rad."""

REACH = np.array([1.2, 1.2, 0.75, 0.4, 0.35, 0.25])
"""No point of the arm or its camera is further from the joint's axis, m."""


class Clearance:
    """Judges joint positions of the arm in one scene; the model stays as it is."""

    def __init__(
        self,
        model: mujoco.MjModel,
        joints: tuple[str, ...],
        margin: float = 0.02,
        view: tuple[float, float] = VIEW,
    ) -> None:
        """`margin`: what must stay between the arm and anything else, m; `view`: see `VIEW`.

        SimulationError if the arm is not in the model.
        """
        self.margin = margin
        self._model = copy.copy(model)
        self.address = joint_addresses(model, joints)
        arm = _bodies_of_arm(model)
        self._arm_only(np.isin(model.geom_bodyid, arm), margin)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_kinematics(self._model, self._data)
        base = model.body(BASE).id
        self.T_world_base: Array = se3.make(
            self._data.xmat[base].reshape(3, 3), self._data.xpos[base]
        )
        # The camera and what turns with it can never come before its eyes.
        behind = [model.body(LINKS[-1]).id]
        behind += [model.body(CAMERA).id] if CAMERA in _names(model) else []
        in_sight = np.isin(model.geom_bodyid, np.setdiff1d(arm, behind))
        self._capsules = np.flatnonzero(
            in_sight & (model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE)
        )
        self._sides = _sides(view)

    def _arm_only(self, arm: NDArray[np.bool_], margin: float) -> None:
        """Let the arm's capsules meet themselves and all that is visible or solid; nothing else."""
        model = self._model
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        material = np.asarray(model.geom_matid)
        alpha = np.asarray(model.geom_rgba[:, 3])
        if model.nmat:
            alpha = np.where(material >= 0, model.mat_rgba[np.maximum(material, 0), 3], alpha)
        scene = ~arm & (solid | ((model.geom_group <= 2) & (alpha > 0.0)))
        arm = arm & solid
        # Bits: 1 the arm, 2 the scene.
        model.geom_contype[:] = np.where(arm, 1, np.where(scene, 2, 0))
        model.geom_conaffinity[:] = np.where(arm, 3, 0)
        model.geom_margin[:] = np.where(arm, margin, 0.0)
        model.geom_gap[:] = 0.0
        model.body_margin[:] = 0.0
        for values, out in (
            (model.geom_contype, model.body_contype),
            (model.geom_conaffinity, model.body_conaffinity),
        ):
            out[:] = 0
            np.bitwise_or.at(out, model.geom_bodyid, values)
        np.maximum.at(model.body_margin, model.geom_bodyid, model.geom_margin)
        # The trees of the bodies were built for what could collide before.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)

    def contacts(self, q: Array) -> list[tuple[str, str]]:
        """What comes closer than the margin with the arm's joints at `q` (n,): bodies or geoms."""
        self._move(q)
        mujoco.mj_collision(self._model, self._data)
        pairs = self._data.contact.geom[: self._data.ncon]
        return [(self._name(int(a)), self._name(int(b))) for a, b in pairs]

    def free(self, q: Array) -> bool:
        """Whether nothing comes closer than the margin with the arm's joints at `q` (n,)."""
        self._move(q)
        mujoco.mj_collision(self._model, self._data)
        return self._data.ncon == 0

    def nearest(self, q: Array) -> tuple[float, tuple[str, str]]:
        """The least distance with the arm's joints at `q` (n,), m, and between what.

        Below 0: how deep they are in each other. What is further away than the margin is not
        looked at: the margin then, and two empty names.
        """
        self._move(q)
        mujoco.mj_collision(self._model, self._data)
        if self._data.ncon == 0:
            return self.margin, ("", "")
        contacts = self._data.contact
        k = int(np.argmin(contacts.dist[: self._data.ncon]))
        one, other = contacts.geom[k]
        return float(contacts.dist[k]), (self._name(int(one)), self._name(int(other)))

    def path_free(self, q_from: Array, q_to: Array) -> bool:
        """Whether the straight way from joints to joints is free.

        It is sampled so finely that between two samples nothing gets through the margin.
        """
        steps = int(np.ceil(np.abs(q_to - q_from) @ REACH / (1.5 * self.margin)))
        # From coarse to fine: a blocked way is found out early.
        shares = sorted(np.arange(1, steps) / steps, key=lambda share: (abs(share - 0.5), share))
        return all(self.free(q_from + share * (q_to - q_from)) for share in shares)

    def out_of_sight(self, q: Array, T_world_camera: Array) -> bool:
        """Whether no part of the arm is in the view cone of a camera (4, 4), behind things too."""
        self._move(q)
        centre, axis = self._data.geom_xpos[self._capsules], self._data.geom_xmat[self._capsules]
        size = self._model.geom_size[self._capsules]
        # A capsule as balls along its axis; three quarters of a radius apart they bulge by 7 %.
        share = np.linspace(-1.0, 1.0, 17)
        along = size[:, 1:2] * share
        balls = centre[:, None] + axis[:, [2, 5, 8]][:, None] * along[..., None]
        p_camera = (balls - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        inside = np.min(p_camera @ self._sides.T, axis=-1)
        return bool((inside < -1.07 * size[:, :1]).all())

    def _move(self, q: Array) -> None:
        self._data.qpos[self.address] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)

    def _name(self, geom: int) -> str:
        own = self._model.geom(geom).name
        return own or self._model.body(int(self._model.geom_bodyid[geom])).name


def joint_addresses(model: mujoco.MjModel, joints: tuple[str, ...]) -> NDArray[np.int64]:
    """Where the arm's joints stand in qpos; SimulationError names one that is missing."""
    missing = [
        joint for joint in joints if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint) < 0
    ]
    if missing or BASE not in _names(model):
        raise SimulationError(
            f"the scene has no arm: {', '.join(missing) or BASE} is not in it;"
            " expected sim.robots.ur16e.add_ur16e in its builder"
        )
    return np.array([model.joint(joint).qposadr[0] for joint in joints], np.int64)


def _names(model: mujoco.MjModel) -> set[str]:
    return {model.body(body).name for body in range(model.nbody)}


def _bodies_of_arm(model: mujoco.MjModel) -> list[int]:
    """The base and all that hangs on it; parents come before their children."""
    found = [model.body(BASE).id]
    for body in range(found[0] + 1, model.nbody):
        if int(model.body_parentid[body]) in found:
            found.append(body)
    return found


def _sides(view: tuple[float, float]) -> Array:
    """Inward unit normals (4, 3) of the four planes of a view cone, camera frame."""
    (sx, sy), (cx, cy) = np.sin(np.multiply(view, 0.5)), np.cos(np.multiply(view, 0.5))
    return np.array([[cx, 0, sx], [-cx, 0, sx], [0, cy, sy], [0, -cy, sy]])
