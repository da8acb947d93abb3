"""Closed triangle surfaces: extrusions with holes, surfaces of revolution, tubes, lumps.

Round contours are polygons whose corners stand out as far as their sides fall short: with the
default 128 segments that is 0.008 mm for a radius of 0.05 m, 0.03 mm for 0.2 m.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, cKDTree

from sim.errors import SimulationError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SEGMENTS = 128


class Solid(NamedTuple):
    """A closed surface: vertices (n, 3) m, faces (m, 3) counter-clockwise seen from outside."""

    vertices: Array
    faces: Indices

    def moved(self, at: Sequence[float] = (0.0, 0.0, 0.0), turn: Array | None = None) -> Solid:
        """The solid turned about its origin by `turn` (3, 3), then shifted by `at` m."""
        turned = self.vertices if turn is None else np.einsum("ij,nj->ni", turn, self.vertices)
        return Solid(turned + np.asarray(at, float), self.faces)

    def bent(self, change: Callable[[Array], Array]) -> Solid:
        """The solid with its vertices (n, 3) changed by a function that keeps it closed."""
        return Solid(change(self.vertices), self.faces)


def joined(solids: Iterable[Solid]) -> Solid:
    """Several solids as one mesh; where they touch or overlap they are not merged."""
    vertices, faces, count = [], [], 0
    for solid in solids:
        vertices.append(solid.vertices)
        faces.append(solid.faces + count)
        count += len(solid.vertices)
    return Solid(np.concatenate(vertices), np.concatenate(faces))


def about(axis: int, angle: float) -> Array:
    """The rotation (3, 3) by `angle` rad about coordinate axis 0, 1 or 2."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.eye(3)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    turn[j, j] = turn[k, k] = cos
    turn[k, j], turn[j, k] = sin, -sin
    return turn


LYING = about(1, 0.5 * np.pi)
"""Turns z into x."""

UPRIGHT = about(0, 0.5 * np.pi)
"""Turns y into z and z into -y: a contour that was drawn lying stands up."""


# Contours: corners (n, 2), counter-clockwise, m.


def circle(radius: float, at: Sequence[float] = (0.0, 0.0), segments: int = SEGMENTS) -> Array:
    """A circle."""
    angle = 2.0 * np.pi * np.arange(segments) / segments
    middling = 2.0 * radius / (1.0 + float(np.cos(np.pi / segments)))
    return np.column_stack([np.cos(angle), np.sin(angle)]) * middling + np.asarray(at, float)


def polygon(radius: float, corners: int, at: Sequence[float] = (0.0, 0.0)) -> Array:
    """A regular polygon, its corners at `radius`."""
    angle = 2.0 * np.pi * np.arange(corners) / corners
    return radius * np.column_stack([np.cos(angle), np.sin(angle)]) + np.asarray(at, float)


def rectangle(half_x: float, half_y: float, at: Sequence[float] = (0.0, 0.0)) -> Array:
    """A rectangle of half lengths."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    return signs * [half_x, half_y] + np.asarray(at, float)


def rounded(
    half_x: float, half_y: float, radius: float, at: Sequence[float] = (0.0, 0.0), arc: int = 16
) -> Array:
    """A rectangle with rounded corners of `arc` segments each; a slot where radius = half_y."""
    angle = 0.5 * np.pi * np.arange(arc + 1) / arc
    corner = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    points = []
    for k, (sx, sy) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        turn = about(2, 0.5 * np.pi * k)[:2, :2]
        centre = np.array([sx * (half_x - radius), sy * (half_y - radius)])
        points.append(np.einsum("ij,nj->ni", turn, corner) + centre)
    ring = np.concatenate(points)
    apart = np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1) > 1e-9
    return ring[apart] + np.asarray(at, float)


def extrude(
    outline: Array, height: float, holes: Sequence[Array] = (), bottom: float = 0.0
) -> Solid:
    """A prism over a contour with holes, all of them through: z from bottom to bottom + height.

    Args:
        outline: Corners (n, 2), counter-clockwise, m.
        height: Its length along z, m.
        holes: Contours (k, 2) inside the outline, counter-clockwise, that do not touch.
        bottom: z of the underside, m.
    """
    rings = [outline, *(hole[::-1] for hole in holes)]
    flat, after, caps = _strip(outline) if _is_plain(rings) else _triangulated(rings)
    n = len(flat)
    index = np.arange(n)
    low = np.column_stack([flat, np.full(n, bottom)])
    high = np.column_stack([flat, np.full(n, bottom + height)])
    sides = [
        np.column_stack([index, after, after + n]), np.column_stack([index, after + n, index + n])
    ]  # fmt: skip
    return Solid(np.concatenate([low, high]), np.concatenate([caps[:, ::-1], caps + n, *sides]))


def _is_plain(rings: list[Array]) -> bool:
    """Whether there are no holes and the outline turns left at every corner."""
    ahead = np.roll(rings[0], -1, axis=0) - rings[0]
    back = np.roll(ahead, 1, axis=0)
    return len(rings) == 1 and bool((back[:, 0] * ahead[:, 1] > back[:, 1] * ahead[:, 0]).all())


def _strip(outline: Array) -> tuple[Array, Indices, Indices]:
    """As `_triangulated`, for a convex outline: a strip from one end to the other."""
    n = len(outline)
    k = np.arange(n - 2)
    left, right = (k + 1) // 2, n - 1 - k // 2
    third = np.where(k % 2 == 0, left + 1, right - 1)
    return outline, np.roll(np.arange(n), -1), np.column_stack([left, third, right])


def _triangulated(rings: list[Array]) -> tuple[Array, Indices, Indices]:
    """Points (n, 2), each one's successor on its ring (n,), triangles (m, 3) between the rings.

    Delaunay's triangulation holds every edge whose diametral circle is empty, so edges are halved
    until theirs are: conforming Delaunay (Ruppert 1995, without the refinement of angles).
    """
    for _ in range(40):
        points = np.concatenate(rings)
        starts = np.cumsum([0, *(len(ring) for ring in rings)])
        after = np.concatenate([
            np.roll(np.arange(a, b), -1) for a, b in pairwise(starts)
        ])  # fmt: skip
        middle, half = 0.5 * (points + points[after]), 0.5 * (points[after] - points)
        radius = np.linalg.norm(half, axis=1)
        near, _ = cKDTree(points).query(middle, k=3)
        # Its own two ends are at `radius`: a third point is nearer where any lies in the circle.
        crowded = near[:, 2] < radius * (1.0 + 1e-6)
        if not crowded.any():
            break
        rings = [
            _halved(ring, crowded[a:b])
            for ring, a, b in zip(rings, starts[:-1], starts[1:], strict=True)
        ]
    # A frame far around keeps the outline's collinear points off the triangulation's rim.
    centre, reach = points.mean(axis=0), 3.0 * float(np.ptp(points, axis=0).max())
    frame = rectangle(reach, reach, centre)
    found = Delaunay(np.concatenate([points, frame]))
    corners = found.simplices.astype(np.int64)
    a, b, c = (found.points[corners[:, k]] for k in range(3))
    double = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    inside = _inside(corners, found.neighbors, after, double > 0.0)
    p, q = points, points[after]
    area = float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum())
    if abs(float(np.abs(double[inside]).sum()) - area) > 1e-9 * abs(area):
        raise SimulationError(f"contour of {len(points)} corners: holes cross or touch the outline")
    corners[double < 0.0] = corners[double < 0.0][:, ::-1]
    return points, after, corners[inside]


def _inside(
    corners: Indices, beside: Indices, after: Indices, positive: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The triangles (m,) within the rings: those on the left of a ring's edge, and all they reach.

    `beside` (m, 3) are the neighbours opposite to each corner, `positive` (m,) says which corners
    run counter-clockwise.
    """
    follow = np.concatenate([after, np.full(4, -1)])
    start, end = np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1)
    along, against = follow[start] == end, follow[end] == start
    left = np.where(positive[:, None], along, against).any(axis=1)
    rows, sides = np.nonzero((beside >= 0) & ~along & ~against)
    count = len(corners)
    graph = coo_array((np.ones(len(rows)), (rows, beside[rows, sides])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return np.isin(label, label[left])


def _halved(ring: Array, where: NDArray[np.bool_]) -> Array:
    middle = 0.5 * (ring + np.roll(ring, -1, axis=0))
    both = np.stack([ring, middle], axis=1).reshape(-1, 2)
    return both[np.column_stack([np.ones(len(ring), bool), where]).ravel()]


# Profiles: points (n, 2) of radius and height, from the axis' foot around the outside, m.


def curve(points: Sequence[Sequence[float]], step: float = 0.004) -> Array:
    """A cubic B-spline from the first to the last of its control points, sampled every `step` m."""
    control = np.asarray(points, float)
    degree = min(3, len(control) - 1)
    knots = np.concatenate(
        [np.zeros(degree), np.linspace(0.0, 1.0, len(control) - degree + 1), np.ones(degree)]
    )
    spline = BSpline(knots, control, degree)
    fine = spline(np.linspace(0.0, 1.0, 400))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    count = max(2, round(float(length[-1]) / step) + 1)
    at = np.interp(np.linspace(0.0, length[-1], count), length, np.linspace(0.0, 1.0, 400))
    return np.asarray(spline(at))


def arc(centre: Sequence[float], radius: float, start: float, end: float, count: int = 9) -> Array:
    """Points (count, 2) of an arc from the angle `start` to `end`, rad."""
    angle = np.linspace(start, end, count)
    return np.column_stack([np.cos(angle), np.sin(angle)]) * radius + np.asarray(centre, float)


def revolve(profile: Array, segments: int = SEGMENTS) -> Solid:
    """The solid that a profile (n, 2) of radius and height sweeps about z.

    A profile that starts and ends on the axis closes there; any other is a ring, its last point
    followed by its first. It runs counter-clockwise: up on the outside.
    """
    apart = np.linalg.norm(np.diff(profile, axis=0), axis=1) > 1e-9
    profile = profile[np.concatenate([[True], apart])]
    closed = profile[0, 0] > 1e-12
    ring = profile if closed else profile[1:-1]
    flat = circle(1.0, segments=segments)
    rings = np.concatenate(
        [ring[:, None, :1] * flat, np.broadcast_to(ring[:, None, 1:], (len(ring), segments, 1))],
        axis=2,
    )
    return _skin(rings, None if closed else (profile[0, 1], profile[-1, 1]))


def _skin(rings: Array, poles: tuple[float, float] | None) -> Solid:
    """The surface over rings (k, n, 3): capped at poles (their z), or closed on itself."""
    k, n = rings.shape[:2]
    index = np.arange(k * n).reshape(k, n)
    after = np.roll(index, -1, axis=1)
    above, above_after = np.roll(index, -1, axis=0), np.roll(after, -1, axis=0)
    rows = slice(None) if poles is None else slice(0, -1)
    quads = np.stack([index[rows], after[rows], above_after[rows], above[rows]], axis=-1)
    quads = quads.reshape(-1, 4)
    faces, vertices = [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], [rings.reshape(-1, 3)]
    if poles is not None:
        ends = rings[0].mean(axis=0), rings[-1].mean(axis=0)
        if not np.isnan(poles).any():
            ends = np.array([0.0, 0.0, poles[0]]), np.array([0.0, 0.0, poles[1]])
        vertices.append(np.stack(ends))
        faces.append(np.stack([np.full(n, k * n), after[0], index[0]], axis=-1))
        faces.append(np.stack([np.full(n, k * n + 1), index[-1], after[-1]], axis=-1))
    return Solid(np.concatenate(vertices), np.concatenate(faces))


def tube(path: Array, radius: Array | float, segments: int = 32, flat: float = 1.0) -> Solid:
    """A round bar along a path (n, 3) with flat ends.

    Args:
        path: Points of its centre line, m.
        radius: One, or one a point (n,), m.
        segments: Corners of its section.
        flat: The section's second axis over its first, for straps.
    """
    ahead = np.gradient(path, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    # Its first side is carried along without twist.
    side = np.cross(ahead[0], [0.0, 0.0, 1.0] if abs(ahead[0, 2]) < 0.9 else [1.0, 0.0, 0.0])
    sides = []
    for direction in ahead:
        side = side - (side @ direction) * direction
        side = side / np.sqrt(side @ side)
        sides.append(side)
    first = np.array(sides)
    second = np.cross(ahead, first)
    r = np.broadcast_to(np.asarray(radius, float), len(path))[:, None, None]
    unit = circle(1.0, segments=segments)
    rings = path[:, None] + r * (
        unit[:, :1] * first[:, None] + flat * unit[:, 1:] * second[:, None]
    )
    return _skin(rings, (np.nan, np.nan))


@cache
def _icosphere(level: int) -> Solid:
    """The unit sphere of 20 * 4 ** level triangles."""
    g = 0.5 * (1.0 + 5.0**0.5)
    corners = [(0, s, t * g) for t in (-1, 1) for s in (-1, 1)]
    points = np.array([np.roll(c, k) for k in range(3) for c in corners], float)
    points /= np.linalg.norm(points[0])
    gap = np.linalg.norm(points[:, None] - points, axis=2)
    near = (gap > 0.0) & (gap < 1.1)
    faces = np.array([
        (i, j, k) for i in range(12) for j in range(i + 1, 12) for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ])  # fmt: skip
    for _ in range(level):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
        unique, which = np.unique(edges, axis=0, return_inverse=True)
        middle = points[unique].sum(axis=1)
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        ab, bc, ca = which.reshape(3, -1) + len(points)
        a, b, c = faces.T
        points = np.concatenate([points, middle])
        faces = np.concatenate([
            np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))
        ])  # fmt: skip
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return Solid(points, faces.astype(np.int64))


def lump(
    rng: np.random.Generator, half: Sequence[float], bumps: float, waves: float, level: int = 4
) -> Solid:
    """An ellipsoid of half lengths `half` m with smooth bumps of the relative height `bumps`.

    `waves` is how quickly they vary: 1 one side thicker than the other, 6 knobbly.
    """
    sphere = _icosphere(level)
    direction = rng.normal(size=(3, 8))
    direction *= waves / np.linalg.norm(direction, axis=0)
    phase = np.einsum("ni,ij->nj", sphere.vertices, direction) + rng.uniform(0.0, 2.0 * np.pi, 8)
    height = 1.0 + bumps * np.sin(phase).mean(axis=1, keepdims=True) * np.sqrt(8.0)
    return Solid(sphere.vertices * height * np.asarray(half, float), sphere.faces)


def sheet(height: Array, half_x: float, half_y: float) -> Solid:
    """A body on its flat underside z = 0 and a top of heights (rows, columns) m, along y, x."""
    rows, columns = height.shape
    y, x = np.meshgrid(
        np.linspace(-half_y, half_y, rows), np.linspace(-half_x, half_x, columns), indexing="ij"
    )
    top = np.column_stack([x.ravel(), y.ravel(), height.ravel()])
    index = np.arange(rows * columns).reshape(rows, columns)
    cells = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)
    rim = np.concatenate([index[0], index[1:, -1], index[-1, -2::-1], index[-2:0:-1, 0]])
    foot = top[rim] * [1.0, 1.0, 0.0]
    low = np.arange(len(rim)) + len(top)
    skirt = np.stack([rim, low, np.roll(low, -1), np.roll(rim, -1)], axis=-1)
    quads = np.concatenate([cells.reshape(-1, 4), skirt])
    hub = len(top) + len(rim)
    under = np.stack([np.full(len(rim), hub), np.roll(low, -1), low], axis=-1)
    vertices = np.concatenate([top, foot, [[0.0, 0.0, 0.0]]])
    return Solid(vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], under]))
