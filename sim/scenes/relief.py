"""A height raster on which a scene is piled up, and how bodies come to rest on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Array = NDArray[np.float64]


class Hull(NamedTuple):
    """A convex body: vertices (n, 3) m, outward faces (m, 3), planes (k, 4) with n.x + d <= 0."""

    vertices: Array
    faces: NDArray[np.int64]
    planes: Array


def hull_of(points: Array) -> Hull:
    """The convex hull of points (n, 3), faces turned outwards and unused points dropped."""
    hull = ConvexHull(points)
    used = np.unique(hull.simplices)
    number = np.full(len(points), -1)
    number[used] = np.arange(len(used))
    faces = number[hull.simplices]
    vertices = points[used]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return Hull(vertices, faces, np.unique(hull.equations.round(9), axis=0))


def box_planes(size: tuple[float, float, float]) -> Array:
    """The six planes (6, 4) of a box with half lengths `size` m."""
    normals = np.vstack([np.eye(3), -np.eye(3)])
    return np.column_stack([normals, -np.tile(size, 2)])


def turned(planes: Array, rotation: Array) -> Array:
    """Planes (k, 4) of a body after a rotation (3, 3) about its origin."""
    return np.column_stack([planes[:, :3] @ rotation.T, planes[:, 3]])


def frame(up: Array, ahead: Array) -> Array:
    """The rotation (3, 3) whose z axis is along `up` and whose x axis is nearest to `ahead`."""
    z = up / np.sqrt(up @ up)
    x = ahead - (ahead @ z) * z
    x /= np.sqrt(x @ x)
    y = (z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0])
    return np.column_stack([x, y, z])


@dataclass
class Relief:
    """Heights z[row, column] m of the highest surface, node [0, 0] at `origin` (x, y) m."""

    z: Array
    origin: tuple[float, float]
    spacing: float

    def at(self, x: Array | float, y: Array | float) -> Array:
        """Heights by bilinear interpolation; the border value outside."""
        rows, columns = self.z.shape
        v = np.clip((np.asarray(y, float) - self.origin[1]) / self.spacing, 0.0, rows - 1.001)
        u = np.clip((np.asarray(x, float) - self.origin[0]) / self.spacing, 0.0, columns - 1.001)
        r, c = v.astype(np.intp), u.astype(np.intp)
        v, u = v - r, u - c
        below = self.z[r, c] * (1.0 - u) + self.z[r, c + 1] * u
        above = self.z[r + 1, c] * (1.0 - u) + self.z[r + 1, c + 1] * u
        return np.asarray(below * (1.0 - v) + above * v)

    def finer(self, x: float, y: float, radius: float, spacing: float) -> Relief:
        """A copy of the square around (x, y) with another spacing, m."""
        count = round(2.0 * radius / spacing) + 1
        step = np.asarray(spacing * np.arange(count) - radius, np.float64)
        z = self.at((x + step)[None, :], (y + step)[:, None])
        return Relief(z, (x - radius, y - radius), spacing)

    def slope(self, x: float, y: float, reach: float) -> Array:
        """The gradient (2,) of the surface, taken over a distance `reach` m to either side."""
        h = self.at(np.array([x + reach, x - reach, x, x]), np.array([y, y, y + reach, y - reach]))
        return np.array([h[0] - h[1], h[2] - h[3]]) / (2.0 * reach)

    def window(self, x: float, y: float, radius: float) -> tuple[tuple[slice, slice], Array, Array]:
        """The nodes within a square around (x, y): slices into z, and their offsets dx, dy."""
        rows, columns = self.z.shape
        reach = np.array([-radius, radius])
        c0, c1 = self._nodes(x + reach - self.origin[0], columns)
        r0, r1 = self._nodes(y + reach - self.origin[1], rows)
        dx = np.asarray(self.origin[0] + self.spacing * np.arange(c0, c1) - x, np.float64)
        dy = np.asarray(self.origin[1] + self.spacing * np.arange(r0, r1) - y, np.float64)
        return (slice(r0, r1), slice(c0, c1)), dx[None, :], dy[:, None]

    def _nodes(self, span: Array, count: int) -> tuple[int, int]:
        """The first of the nodes around a span (2,) m, and the one after the last."""
        first, last = span / self.spacing
        return (
            min(max(int(np.floor(first)), 0), count),
            min(max(int(np.ceil(last)) + 1, 0), count),
        )

    def raise_to(self, planes: Array, x: float, y: float, z: float, radius: float) -> None:
        """Lift the surface to the top of a convex body standing at (x, y, z)."""
        where, dx, dy = self.window(x, y, radius)
        bottom, top = _span(planes, dx, dy)
        self.z[where] = np.where(top >= bottom, np.maximum(self.z[where], top + z), self.z[where])

    def bed(
        self, planes: Array, x: float, y: float, radius: float, sink: float, raising: bool = True
    ) -> float:
        """Lay a convex body down at (x, y) and lift the surface to its top; returns its height.

        It lies where a share `sink` of its underside has sunk into what was there. With `raising`
        False the surface stays as it was.
        """
        where, dx, dy = self.window(x, y, radius)
        bottom, top = _span(planes, dx, dy)
        inside = top >= bottom
        old = self.z[where]
        touch = (old - bottom)[inside]
        if len(touch) == 0:
            return float(self.at(x, y))
        order = int((1.0 - sink) * (len(touch) - 1))
        z = float(np.partition(touch, order)[order])
        if raising:
            self.z[where] = np.where(inside, np.maximum(old, top + z), old)
        return z


def _span(planes: Array, dx: Array, dy: Array) -> tuple[Array, Array]:
    """The lowest and the highest z of a convex body over offsets dx (1, n), dy (m, 1)."""
    nx, ny, nz, d = (planes[:, k][:, None, None] for k in range(4))
    rest = -(d + nx * dx[None] + ny * dy[None])
    flat = np.abs(planes[:, 2]) < 1e-6
    up, down = planes[:, 2] >= 1e-6, planes[:, 2] <= -1e-6
    top = (rest[up] / nz[up]).min(axis=0)
    bottom = (rest[down] / nz[down]).max(axis=0)
    if flat.any():
        top = np.where((rest[flat] < 0.0).any(axis=0), -np.inf, top)
    return bottom, top


def rest_on_three(
    relief: Relief,
    x: float,
    y: float,
    yaw: float,
    half: tuple[float, float],
    pressed: float = 0.0,
) -> tuple[Array, Array]:
    """How a flat-bottomed body of half lengths `half` m comes to rest: it stands on three points.

    Those are the corners of the upper convex hull's facet above which the centre of mass hangs, so
    the pose is in static equilibrium. Its weight then takes it down by the share `pressed` of the
    mean gap below it. Returns the rotation (3, 3) and the bottom's centre (3,).
    """
    cos, sin = np.cos(yaw), np.sin(yaw)
    reach = [np.arange(-h, h + 1e-9, max(relief.spacing, h / 150.0)) for h in half]
    u, v = (a.ravel() for a in np.meshgrid(*reach))
    px, py = x + cos * u - sin * v, y + sin * u + cos * v
    points = np.column_stack([u, v, relief.at(px, py)])
    try:
        hull = ConvexHull(points)
    except QhullError:  # a flat floor: any three points carry it
        normal, height = np.array([0.0, 0.0, 1.0]), float(points[:, 2].max())
    else:
        over = hull.equations[hull.equations[:, 2] > 1e-6]
        heights = -over[:, 3] / over[:, 2]
        # Above the centre the hull's top is its lowest upper plane.
        facet = int(np.argmin(heights))
        normal, height = over[facet, :3], float(heights[facet])
        plane = height - points[:, :2] @ normal[:2] / normal[2]
        height -= pressed * float((plane - points[:, 2]).mean())
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return frame(turn @ normal, turn[:, 0]), np.array([x, y, height])
