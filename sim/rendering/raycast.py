"""Exact depth by casting rays with Embree against the triangles of a compiled MuJoCo model.

Embree finds the triangle in single precision; the distance is then taken to that triangle's plane
in double precision. Directions with camera z = 1 make the distance the depth. No GL is needed.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera
from sim.engine import mujoco
from sim.errors import SimulationError
from sim.rendering import embree
from sim.rendering.tessellate import SEGMENTS, Shapes, Triangles

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Hits:
    """What rays of any leading shape met; a ray that met nothing has NaN and -1."""

    distance: Array
    """(...) in units of the direction's length: the depth where its camera z is 1, m."""
    triangle: NDArray[np.int64]
    """(...) index into the scene's triangles."""
    geom: NDArray[np.int64]
    """(...) geom id."""


def world_rays(camera: Camera, T_world_camera: Array) -> Array:
    """The pixels' viewing rays (height, width, 3) in world axes, each of camera z = 1."""
    # einsum, not @: a threaded product of so thin a matrix waits for other processes' threads.
    return np.asarray(np.einsum("ij,hwj->hwi", T_world_camera[:3, :3], camera.rays()))


class RayScene:
    """The triangles of a model at one pose, ready to be hit by rays."""

    def __init__(self, triangles: Triangles) -> None:
        """Build the acceleration structure; MissingPackage if embreex is not there."""
        self.triangles = triangles
        self._shapes: Shapes | None = None
        self._plane = np.empty((len(triangles.faces), 4))
        _planes(triangles.vertices, triangles.faces, self._plane)
        self._embree = embree.build(
            triangles.vertices.astype(np.float32), triangles.faces.astype(np.int32)
        )

    @property
    def normals(self) -> Array:
        """(m, 3) outward unit normals of the triangles, world frame."""
        return self._plane[:, :3]

    @classmethod
    def of_model(
        cls,
        model: mujoco.MjModel,
        data: mujoco.MjData | None = None,
        groups: tuple[int, ...] = (0, 1, 2),
        segments: int = SEGMENTS,
    ) -> RayScene:
        """The visible geoms of a model, at its initial pose unless `data` has another."""
        if data is None:
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
        shapes = Shapes(model, groups, segments)
        scene = cls(shapes.at(data))
        scene._shapes = shapes
        return scene

    def at(self, data: mujoco.MjData) -> RayScene:
        """The same model at another pose, quicker than `of_model`; only for a scene made by that.

        `data` must hold the forward kinematics.
        """
        if self._shapes is None:
            raise SimulationError("a scene of bare triangles has no joints to move")
        scene = type(self)(self._shapes.at(data))
        scene._shapes = self._shapes
        return scene

    def cast(self, origins: Array, directions: Array) -> Hits:
        """Shoot rays from origins (3,) or (..., 3) along directions (..., 3), world frame, m.

        Rays that are neighbours in memory should be neighbours in space: they go faster.
        """
        shape = directions.shape[:-1]
        d = np.ascontiguousarray(directions.reshape(-1, 3), float)
        o = np.atleast_2d(np.asarray(origins, float))
        if len(o) > 1 or o.ndim > 2:
            o = np.broadcast_to(o, directions.shape).reshape(-1, 3)
        found = self._embree.first(o.astype(np.float32), d.astype(np.float32))
        hits = _nothing(len(d))
        embree.measure(found, o, d, self._plane, self.triangles.geom, *hits)
        distance, triangle, geom = hits
        return Hits(distance.reshape(shape), triangle.reshape(shape), geom.reshape(shape))

    def view(self, camera: Camera, T_world_camera: Array) -> Hits:
        """One ray through each pixel's centre: `distance` (height, width) is the exact depth, m."""
        if self._embree.handle is None:
            return self.cast(T_world_camera[:3, 3], world_rays(camera, T_world_camera))
        hits = _nothing((camera.height, camera.width))
        T = np.ascontiguousarray(T_world_camera, float)
        embree.view(self._embree.handle, camera.rays(), T, self._plane, self.triangles.geom, *hits)
        return Hits(*hits)

    def incidence(self, camera: Camera, T_world_camera: Array, hits: Hits) -> Array:
        """Cosine of the angle (height, width) between each pixel's ray and the surface's normal.

        1: seen straight on, 0: along the surface, NaN: nothing seen.
        """
        cosine = np.empty(hits.triangle.shape)
        T = np.ascontiguousarray(T_world_camera, float)
        _incidence(hits.triangle, camera.rays(), T, self._plane, cosine)
        return cosine

    def normals_of(self, hits: Hits, T_world_camera: Array | None = None) -> Array:
        """Unit normals (..., 3) of the surfaces hit, outward; NaN where nothing was hit.

        In world axes, or in the camera's where its pose is given.
        """
        normal = self.normals[np.maximum(hits.triangle, 0)]
        if T_world_camera is not None:
            normal = np.einsum("...i,ij->...j", normal, T_world_camera[:3, :3])
        return np.where(hits.triangle[..., None] >= 0, normal, np.nan)

    def blocked(
        self,
        points: NDArray[np.floating],
        direction: NDArray[np.floating],
        reach: float | NDArray[np.floating] = np.inf,
    ) -> NDArray[np.bool_]:
        """Whether anything stands in the way from points (n, 3) along direction (3,) or (n, 3).

        `reach`, one or (n,), says how far to look, in lengths of the direction. What begins at the
        point itself counts: start a little off the surface. A point that is NaN is not blocked.
        """
        return self._embree.blocked(
            np.ascontiguousarray(points, np.float32),
            np.atleast_2d(np.ascontiguousarray(direction, np.float32)),
            np.atleast_1d(np.asarray(reach, np.float32)),
        )

    def visible_from(self, points: Array, eye: Array) -> NDArray[np.bool_]:
        """Whether points (..., 3) on surfaces can be seen from eye (3,); False for NaN.

        The last ten-thousandth of the way does not count: there lies the surface itself.
        """
        p = points.reshape(-1, 3)
        hidden = self._embree.blocked(
            np.asarray(eye, np.float32)[None],
            np.ascontiguousarray(p - eye, np.float32),
            np.array([1.0 - NEAR_THE_SURFACE], np.float32),
        )
        return np.asarray((~hidden & np.isfinite(p).all(axis=1)).reshape(points.shape[:-1]))


NEAR_THE_SURFACE = 1e-4
"""Share of a line of sight before its end that is not searched for obstacles."""


def _nothing(shape: int | tuple[int, ...]) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    return np.empty(shape), np.empty(shape, np.int64), np.empty(shape, np.int64)


@nb.njit(cache=True, nogil=True)
def _planes(vertices, faces, plane):
    """Fill each triangle's plane (m, 4): outward unit normal n and n.p of its points p."""
    for k in range(len(faces)):
        a, b, c = vertices[faces[k, 0]], vertices[faces[k, 1]], vertices[faces[k, 2]]
        x = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
        y = (b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2])
        z = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        length = np.sqrt(x * x + y * y + z * z)
        scale = 1.0 / length if length > 0.0 else 0.0
        plane[k, 0], plane[k, 1], plane[k, 2] = x * scale, y * scale, z * scale
        plane[k, 3] = (x * a[0] + y * a[1] + z * a[2]) * scale


@nb.njit(cache=True, nogil=True)
def _incidence(triangle, rays, T, plane, cosine):
    for y in range(triangle.shape[0]):
        for x in range(triangle.shape[1]):
            k = triangle[y, x]
            if k < 0:
                cosine[y, x] = np.nan
                continue
            # The normal in the camera's axes.
            total = 0.0
            for c in range(3):
                n = plane[k, 0] * T[0, c] + plane[k, 1] * T[1, c] + plane[k, 2] * T[2, c]
                total += n * rays[y, x, c]
            a, b, c = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
            cosine[y, x] = abs(total) / np.sqrt(a * a + b * b + c * c)
