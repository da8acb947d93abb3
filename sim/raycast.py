"""Exact depth by casting rays with Embree against the triangles of a compiled MuJoCo model.

Embree finds the triangle in single precision; the distance is then taken to that triangle's plane
in double precision. Directions with camera z = 1 make the distance the depth. No GL is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera
from depthba.errors import MissingPackage
from sim.engine import mujoco
from sim.tessellate import SEGMENTS, Triangles, triangles_of

Array = NDArray[np.float64]

MISS = 1e30
"""Embree reports 1e37 for a ray that meets nothing."""


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
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise MissingPackage(
                f"embreex is not installed ({error}): pip install 'depthba[sim]'"
            ) from error
        self.triangles = triangles
        corner = triangles.vertices[triangles.faces]
        self._corner = np.ascontiguousarray(corner[:, 0])
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        self.normals: Array = normal / np.where(length > 0.0, length, 1.0)
        """(m, 3) outward unit normals of the triangles, world frame."""
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(
            self._scene, triangles.vertices.astype(np.float32), triangles.faces.astype(np.int32)
        )

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
        return cls(triangles_of(model, data, groups, segments))

    def cast(self, origins: Array, directions: Array) -> Hits:
        """Shoot rays from origins (3,) or (..., 3) along directions (..., 3), world frame, m."""
        shape = directions.shape[:-1]
        d = np.ascontiguousarray(directions.reshape(-1, 3), float)
        o = np.broadcast_to(origins, directions.shape).reshape(-1, 3)
        found = np.asarray(
            self._scene.run(np.ascontiguousarray(o, np.float32), d.astype(np.float32)), np.int64
        )
        hit = found >= 0
        triangle = found[hit]
        normal = self.normals[triangle]
        # The plane's distance along the ray; the float32 answer would be good to a micrometre.
        above = np.einsum("ij,ij->i", self._corner[triangle] - o[hit], normal)
        towards = np.einsum("ij,ij->i", d[hit], normal)
        distance = np.full(len(d), np.nan)
        geom = np.full(len(d), -1)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance[hit] = above / towards
        geom[hit] = self.triangles.geom[triangle]
        return Hits(distance.reshape(shape), found.reshape(shape), geom.reshape(shape))

    def view(self, camera: Camera, T_world_camera: Array) -> Hits:
        """One ray through each pixel's centre: `distance` (height, width) is the exact depth, m."""
        return self.cast(T_world_camera[:3, 3], world_rays(camera, T_world_camera))

    def blocked(self, points: NDArray[np.floating], direction: Array) -> NDArray[np.bool_]:
        """Whether anything stands in the way from points (n, 3) along one direction (3,)."""
        o = np.ascontiguousarray(points, np.float32)
        d = np.ascontiguousarray(np.broadcast_to(direction, points.shape), np.float32)
        return np.asarray(self._scene.run(o, d, query="OCCLUDED")) >= 0
