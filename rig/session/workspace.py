"""Where a rig may be: every place and every way is judged here before anything moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from depthba.errors import OptionError, OutOfReach
from depthba.kinematics import DhArm
from depthba.straight import straight
from rig.session.options import Limits, Session

Array = NDArray[np.float64]

_STEP = 0.02
"""Ways are looked at in steps no longer than this, rad or m."""


@dataclass(frozen=True, eq=False)
class Body:
    """What moves: joints of an arm, rad, or axes of a gantry, m."""

    names: tuple[str, ...]
    lower: Array
    upper: Array
    """(n,)."""
    unit: str
    """"rad" or "m"."""
    forward: Callable[[Array], Array]
    """T_base_flange (..., 4, 4) at joints (..., n)."""
    arm: DhArm | None = None
    """Of an arm; a gantry has none."""


@dataclass(frozen=True, eq=False)
class Workspace:
    """A body, the camera on it, and the limits for both."""

    body: Body
    T_world_base: Array
    T_flange_camera: Array
    """(4, 4), as believed."""
    limits: Limits
    move: Literal["joints", "linear"] = "joints"
    rest: Array | None = None
    """(n,) joints over which a way may lead."""

    @classmethod
    def of(cls, session: Session, body: Body) -> Workspace:
        """From a session; OptionError where its joints are not those of the body."""
        n, limits = len(body.names), session.limits
        for name, values in (
            ("limits.lower", limits.lower),
            ("limits.upper", limits.upper),
            ("motion.rest", session.motion.rest),
        ):
            if values is not None and len(values) != n:
                raise OptionError(f"{name}: {len(values)} numbers, expected {n}")
        lower = body.lower if limits.lower is None else np.maximum(body.lower, limits.lower)
        upper = body.upper if limits.upper is None else np.minimum(body.upper, limits.upper)
        rest = session.motion.rest
        space = cls(
            replace(body, lower=lower, upper=upper),
            np.array(session.T_world_base),
            np.array(session.hand_eye),
            limits,
            session.motion.move,
            None if rest is None else np.array(rest),
        )
        if space.rest is not None and (reason := space.why_not(space.rest)):
            raise OptionError(f"motion.rest: {reason}")
        return space

    def camera_at(self, q: Array) -> Array:
        """T_world_camera (..., 4, 4) at joints (..., n), as believed."""
        return np.asarray(self.T_world_base @ self.body.forward(q) @ self.T_flange_camera)

    def why_not(self, q: Array) -> str | None:
        """Which limit joints (n,) break, in words; None: none."""
        body = self.body
        if q.shape != body.lower.shape or not np.isfinite(q).all():
            return f"{q.tolist()}: expected {len(body.names)} finite numbers, {body.unit}"
        for name, value, low, high in zip(body.names, q, body.lower, body.upper, strict=True):
            if not low <= value <= high:
                return f"{name} {value:.4g} {body.unit}, expected {low:.4g} to {high:.4g}"
        return self._outside(q[None])

    def fitting(self, q: Array) -> NDArray[np.bool_]:
        """Which of some joints (k, n) break no limit."""
        body = self.body
        kept = ((q >= body.lower) & (q <= body.upper)).all(axis=-1)
        for _, place, box in self._places(q):
            kept &= ((place >= box[::2]) & (place <= box[1::2])).all(axis=-1)
        return np.asarray(kept)

    def why_no_way(self, q_from: Array, q_to: Array) -> str | None:
        """Why the way between joints (n,) must not be gone; None: it may."""
        if self.move == "linear" and self.body.arm is not None:
            try:
                line = straight(self.body.arm, q_from, self.body.forward(q_to))
            except OutOfReach as error:
                return str(error)
            if np.abs(line.joints[-1] - q_to).max() > 1e-3:
                return "a straight line ends in another posture"
            return self._outside(line.joints)
        count = max(int(np.ceil(np.abs(q_to - q_from).max() / _STEP)), 1)
        share = np.linspace(0.0, 1.0, count + 1)[:, None]
        return self._outside(q_from + share * (q_to - q_from))

    def way(self, q_from: Array, q_to: Array) -> tuple[tuple[Array, ...], str | None]:
        """The joints to go to one after the other, or why there is no way."""
        reason = self.why_no_way(q_from, q_to)
        if reason is None:
            return (q_to,), None
        rest = self.rest
        if rest is not None and not (self.why_no_way(q_from, rest) or self.why_no_way(rest, q_to)):
            return (rest, q_to), None
        return (), reason

    def _outside(self, q: Array) -> str | None:
        """The first place that some joints (k, n) in order lead out of a box."""
        for name, places, box in self._places(q):
            out = (places < box[::2]) | (places > box[1::2])
            if out.any():
                row, axis = np.argwhere(out)[0]
                return (
                    f"{name} {'xyz'[axis]} {places[row, axis]:.3f} m, expected"
                    f" {box[2 * axis]:g} to {box[2 * axis + 1]:g} m (limits.{name})"
                )
        return None

    def _places(self, q: Array) -> list[tuple[str, Array, Array]]:
        """Name, places (k, 3) and box (6,) of everything that a box is given for."""
        T_world_flange = self.T_world_base @ self.body.forward(q)
        found = [
            ("camera", (T_world_flange @ self.T_flange_camera)[..., :3, 3], self.limits.camera)
        ]
        if self.limits.flange is not None:
            found.append(("flange", T_world_flange[..., :3, 3], self.limits.flange))
        return [(name, place, np.array(box)) for name, place, box in found]
