"""A sensor held by hand, so to speak: it looks down at any scene from a dome of places above it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.errors import OptionError
from sim.engine import mujoco
from sim.errors import SimulationError
from sim.rendering.tessellate import triangles_of
from sim.rigs.track import Track, Triple, perturbed, scaled
from sim.seeds import stream

Array = NDArray[np.float64]

_GOLDEN = np.pi * (3.0 - 5.0**0.5)


@dataclass(frozen=True)
class Dome:
    """Frames from above, spread over whatever stands in the scene, each from its own direction."""

    frames: int = 12
    overlap: float = 3.0
    """How many frames see a place, in the mean."""
    tilt: float = float(np.radians(30.0))
    """Largest angle between the view and the vertical, rad."""
    sigma_t: float = 0.005
    """Of the reported positions, each axis and frame for itself, m."""
    sigma_r: float = 0.005
    """The same for rotations, rad."""
    seconds: float = 1.0
    """Between frames."""

    def track(
        self,
        model: mujoco.MjModel,
        seed: int,
        frames: int | None = None,
        start_error: tuple[float, float] | None = None,
        scale: float = 1.0,
    ) -> Track:
        """The capture's poses; the sensor itself is not in the model."""
        count = self.frames if frames is None else frames
        if count < 1:
            raise OptionError(f"frames {count}: expected 1 or more")
        T_true = self._poses(model, stream(seed, "dome"), count)
        stamps = np.asarray(self.seconds * np.arange(count), np.float64)
        if start_error is not None:
            return perturbed(stamps, T_true, seed, start_error)
        if scale == 0.0:
            return Track(stamps, T_true, T_true)
        sigma_t: Triple = (self.sigma_t,) * 3
        sigma_r: Triple = (self.sigma_r,) * 3
        noise = scale * np.repeat([self.sigma_t, self.sigma_r], 3)
        errors = noise * stream(seed, "dome-errors").standard_normal((count, 6))
        T = se3.retract(T_true, errors)
        return Track(stamps, T_true, T, scaled(sigma_t, scale), scaled(sigma_r, scale))

    def _poses(self, model: mujoco.MjModel, rng: np.random.Generator, count: int) -> Array:
        low, high = extent(model)
        size, centre = np.maximum(high - low, 0.05)[:2], 0.5 * (low + high)[:2]
        # A view covers about 1.2 x 0.8 of its distance.
        distance = float(np.sqrt(self.overlap * size[0] * size[1] / (count * 0.96)))
        distance = max(distance, 0.4)
        number = (np.arange(count) + 0.5) / count
        radius, angle = np.sqrt(number), _GOLDEN * np.arange(count) + rng.uniform(0.0, 2.0 * np.pi)
        circle = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        # From the disc to the rectangle, so that corners are not left out.
        square = circle * (radius / np.maximum(np.abs(circle).max(axis=1), 1e-9))[:, None]
        aim = np.column_stack([centre + 0.4 * size * square, np.full(count, high[2])])
        lean = self.tilt * np.sqrt(rng.random(count))
        heading = rng.uniform(0.0, 2.0 * np.pi, count)
        away = np.column_stack(
            [np.sin(lean) * np.cos(heading), np.sin(lean) * np.sin(heading), np.cos(lean)]
        )
        return np.array([look(aim[k] + distance * away[k], aim[k]) for k in range(count)])


def look(eye: Array, at: Array) -> Array:
    """T_world_camera (4, 4) of a camera at `eye` that looks at `at` (3,), its x axis level."""
    z = (at - eye) / np.linalg.norm(at - eye)
    # Seen straight from above, the world's y is up in the image.
    x = np.cross(z, [0.0, 0.0, 1.0]) if abs(z[2]) < 0.8 else np.cross([0.0, 1.0, 0.0], -z)
    x /= np.linalg.norm(x)
    return np.asarray(se3.make(np.column_stack([x, np.cross(z, x), z]), eye))


def extent(model: mujoco.MjModel, data: mujoco.MjData | None = None) -> tuple[Array, Array]:
    """The box (low, high) around all visible geoms but planes; the planes where nothing else is."""
    if data is None:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
    triangles = triangles_of(model, data)
    plane = np.asarray(model.geom_type) == mujoco.mjtGeom.mjGEOM_PLANE
    kept = ~plane[triangles.geom]
    points = triangles.vertices[np.unique(triangles.faces[kept if kept.any() else ~kept])]
    low, high = points.min(axis=0), points.max(axis=0)
    if not np.isfinite(high - low).all():
        raise SimulationError("the scene has no finite extent, expected geoms of finite size")
    return np.asarray(low), np.asarray(high)
