"""What happens where the depth jumps: shadow, jittering outlines, flying pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.noise.shot import Shot
from sim.noise.window import windowed
from sim.sensors import DepthSensor

Array = NDArray[np.float64]

STEEPEST = 5.0
"""Slope beyond which neighbouring pixels lie on two surfaces (incidence of 79 degrees)."""

TOLERANCE = 1e-4
"""What must stand before a point to hide it, as a share of its distance from the second eye."""

MARGIN = 0.95
"""How far a neighbour may come within a pixel's line of sight before a ray is cast, pixels."""


@dataclass(frozen=True)
class Shadow:
    """No measurement where the second eye or the projector does not see the surface."""

    name: str = "shadow"
    is_noise: bool = True
    per_frame: bool = True

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""
        eye = "projector" if sensor.active else "second eye"
        return f"hidden from the {eye}, {1e3 * sensor.baseline:g} mm to the right"

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Drop what is hidden, and for a second camera what lies outside its image."""
        sensor = shot.sensor
        z = shot.hits.distance
        # Columns of the second eye's image; across it, whatever hides a pixel lies to the right.
        column = np.arange(sensor.width) - sensor.disparity_at_1m / z
        suspect = _overtaken(column) | _beside(shot, column)
        outside = np.zeros(z.shape, bool) if sensor.active else column < -0.5
        v, u = np.nonzero(suspect & ~outside & np.isfinite(z))
        T = shot.T_world_camera
        points = np.einsum("ij,nj->ni", T[:3, :3], shot.rays(v, u) * z[v, u, None]) + T[:3, 3]
        met = shot.scene.cast(shot.eye, points - shot.eye).distance
        hidden = outside
        hidden[v, u] |= met < 1.0 - TOLERANCE
        return np.where(hidden, np.nan, depth)


def _overtaken(column: Array) -> NDArray[np.bool_]:
    """Where something to the right, seen by the camera, stands at or left of a pixel's column."""
    column = np.where(np.isfinite(column), column, np.inf)
    leftmost = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    found = np.zeros(column.shape, bool)
    found[:, :-1] = leftmost[:, 1:] < column[:, :-1] + MARGIN
    return found


def _beside(shot: Shot, column: Array) -> NDArray[np.bool_]:
    """Where something may stand in the way that is beyond the camera's right border.

    It is taken to be no nearer than the sensor's range begins.
    """
    T, sensor = shot.T_world_camera, shot.sensor
    z = np.einsum("ij,j->i", shot.scene.triangles.vertices - T[:3, 3], T[:3, 2])
    near = max(float(z.min()), sensor.depth_min)
    return column > sensor.width - 0.5 - sensor.disparity_at_1m / near


@dataclass(frozen=True)
class LateralJitter:
    """Outlines stand where they are but for some noise (Handa et al. 2014).

    A pixel takes the depth of the pixel at its jittered place, if an outline lies between. On one
    surface nothing changes: there the window tells the depth at its own centre.
    """

    name: str = "lateral-jitter"
    is_noise: bool = True
    per_frame: bool = True

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""
        return f"outlines displaced by σ = {sensor.lateral:.3g} px"

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Move the outlines."""
        sensor = shot.sensor
        du, dv = (
            np.rint(sensor.lateral * windowed(rng, depth.shape, sensor.window)).astype(np.int32)
            for _ in range(2)
        )
        height, width = depth.shape
        v, u = np.nonzero((du != 0) | (dv != 0))
        du, dv = du[v, u], dv[v, u]
        own = depth[v, u]
        other = depth[np.clip(v + dv, 0, height - 1), np.clip(u + du, 0, width - 1)]
        crossed = _jump(own, other, np.hypot(du, dv), sensor.focal)
        crossed |= np.isnan(own) != np.isnan(other)
        out = depth.copy()
        out[v[crossed], u[crossed]] = other[crossed]
        return out


@dataclass(frozen=True)
class FlyingPixels:
    """A pixel whose footprint holds an outline mixes the depths of both sides, by area.

    Where between two pixels the outline runs is drawn at random.
    """

    name: str = "flying-pixels"
    is_noise: bool = True
    per_frame: bool = True

    def law(self, sensor: DepthSensor) -> str:
        """Its law with the sensor's numbers, in one line."""
        return f"both sides mixed within {0.5 * sensor.flying:.3g} px of an outline"

    def __call__(self, depth: Array, shot: Shot, rng: np.random.Generator) -> Array:
        """Mix depths along outlines."""
        sensor = shot.sensor
        where = rng.random(depth.shape, np.float32)
        other, steps = _across(depth, int(np.ceil(0.5 * sensor.flying)), sensor.focal)
        near = np.flatnonzero(steps)
        away = steps.flat[near] - 1 + where.flat[near]  # pixels to the outline
        share = np.maximum(0.5 - away / max(sensor.flying, 1e-9), 0.0)
        out = depth.copy()
        out.flat[near] += share * (other.flat[near] - depth.flat[near])
        return out


def _jump(a: Array, b: Array, pixels: Array | float, focal: float) -> NDArray[np.bool_]:
    """Whether depths so many pixels apart lie on two surfaces; False where one is a hole."""
    return np.asarray(np.abs(a - b) > STEEPEST / focal * pixels * np.minimum(a, b))


def _across(depth: Array, reach: int, focal: float) -> tuple[Array, NDArray[np.int32]]:
    """For pixels up to `reach` from an outline: the depth beyond it, and how many pixels away.

    Elsewhere 0. The nearest outline counts.
    """
    other, steps = np.zeros_like(depth), np.zeros(depth.shape, np.int32)
    height, width = depth.shape
    edges = []
    for dv, du in ((0, 1), (1, 0)):
        near, far = depth[: height - dv, : width - du], depth[dv:, du:]
        v, u = np.nonzero(_jump(near, far, 1.0, focal))
        edges += [(v, u, -dv, -du, far[v, u]), (v + dv, u + du, dv, du, near[v, u])]
    for k in range(reach, 0, -1):
        for v, u, dv, du, beyond in edges:
            row, column = v + (k - 1) * dv, u + (k - 1) * du
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            other[row[inside], column[inside]] = beyond[inside]
            steps[row[inside], column[inside]] = k
    return other, steps
