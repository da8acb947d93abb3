"""Small problems made by hand: few points and nodes, and all the awkwardness of a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.optimiser.grid import Grid
from depthba.optimiser.linearise import Linearisation, Loss, State
from depthba.optimiser.problem import FramePoints, Problem, extremes

Floats = NDArray[np.float64]

VERTICAL = Loss(False, False, 0.0, 0.1, 0.0, 0.1)
SLOPED = Loss(False, True, 0.02, 0.1, 0.0004, 0.3)
RANGE = Loss(True, True, 0.0, 0.1, 0.001, 0.02)
ROBUST = Loss(True, True, 0.015, 0.1, 0.015**2, 0.02)
LOSSES = {"vertical": VERTICAL, "sloped": SLOPED, "range": RANGE, "robust": ROBUST}


@dataclass(frozen=True)
class Case:
    """A problem, its grid, a state to linearise at and the nodes under the smoothing term."""

    problem: Problem
    grid: Grid
    state: State
    smooth: NDArray[np.bool_]


def frame_points(cloud: Floats) -> FramePoints:
    """Wrap (n, 5) rows: point, inverse noise, share."""
    points, inverse_noise, share = np.split(cloud.astype(np.float32), [3, 4], axis=1)
    xyz = points.astype(float)
    centroid = xyz.mean(axis=0)
    extent = float(np.sqrt(((xyz - centroid) ** 2).sum(axis=1).mean()))
    blocks = (np.arange(len(points)) % 48).astype(np.uint8)
    return FramePoints(
        np.ascontiguousarray(points), inverse_noise.ravel(), share.ravel(), blocks, centroid,
        extremes(points), extent,
    )  # fmt: skip


def rows_of(frame: FramePoints) -> Floats:
    """Return the (n, 5) rows of a frame again."""
    return np.column_stack([frame.points, frame.inverse_noise, frame.share]).astype(float)


def problem_of(clouds: list[Floats], T_map_camera: Floats, spacing: float = 0.02) -> Problem:
    """Wrap clouds (n, 5) and their poses; the map frame is the world."""
    xy = np.concatenate(
        [c[:, :3] @ T[:2, :3].T + T[:2, 3] for c, T in zip(clouds, T_map_camera, strict=True)]
    )
    return Problem(
        frames=tuple(frame_points(c) for c in clouds),
        T_map_camera=T_map_camera,
        T_map_world=np.eye(4),
        lower=xy.min(axis=0),
        upper=xy.max(axis=0),
        origin=True,
        spacing=spacing,
        noise=0.001,
    )


def looking_down(count: int, rng: np.random.Generator, tilt: float = 0.2) -> Floats:
    """Poses (count, 4, 4) about 1 m above the map, tilted by about ``tilt`` radians."""
    T = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (count, 1, 1))
    T[:, :3, :3] = se3.exp_so3(tilt * rng.standard_normal((count, 3))) @ T[:, :3, :3]
    T[:, :3, 3] = rng.uniform([-0.15, -0.15, 0.9], [0.15, 0.15, 1.1], (count, 3))
    return T


def flat_case(
    count: int, near: float = 0.001, far: float = 0.001, frames: int = 2
) -> tuple[Floats, list[Floats]]:
    """Frames over a plane with noise along z, m: poses, clouds (n, 5).

    Every second camera is half as far away, where the noise is that ``near``.
    """
    rng = np.random.default_rng(4)
    T = looking_down(frames, rng, tilt=0.0)
    T[::2, 2, 3] *= 1.0 if near == far else 0.5
    clouds = []
    for i, pose in enumerate(T):
        xy = rng.uniform(-0.3, 0.3, (count, 2))
        q = np.column_stack([xy, (far if i % 2 else near) * rng.standard_normal(count)])
        clouds.append(np.column_stack([(q - pose[:3, 3]) @ pose[:3, :3], np.ones((count, 2))]))
    return T, clouds


def view(
    T: Floats, surface: Callable[[Floats, Floats], Floats], count: int, rng: np.random.Generator
) -> Floats:
    """Return points (count, 3) of a surface, sensor frame, up to 0.3 m from the map's middle."""
    xy = rng.uniform(-0.3, 0.3, (count, 2))
    q = np.column_stack([xy, surface(*xy.T)])
    return np.asarray((q - T[:3, 3]) @ T[:3, :3])


def awkward_case(seed: int = 0, frames: int = 4, count: int = 250) -> Case:
    """A cliff, noise, strays, points off the map, unequal noise, dead shares, bare nodes."""
    rng = np.random.default_rng(seed)
    spacing, shape = 0.04, (17, 19)
    origin = np.array([-0.37, -0.33])
    x, y = np.meshgrid(*(origin[k] + spacing * np.arange(shape[1 - k]) for k in (0, 1)))
    heights = 0.03 * np.sin(9 * x) * np.cos(7 * y) + np.where(x > 0.13, 0.15, 0.0)
    heights += 0.004 * rng.standard_normal(shape)
    T = looking_down(frames, rng)
    clouds = []
    for pose in T:
        p = view(pose, lambda x, y: 0.03 * np.sin(9 * x) * np.cos(7 * y), count, rng)
        p += 0.004 * rng.standard_normal(p.shape)
        p[::40] += 0.2 * rng.standard_normal((len(p[::40]), 3))
        p[5::50, :2] *= 3.0
        share = np.where(rng.uniform(size=count) < 0.05, 0.0, rng.uniform(0.3, 1.0, count))
        cloud = np.column_stack([p, rng.uniform(0.5, 2.0, count), share])
        # some nodes stay without any point
        q = p @ pose[:3, :3].T + pose[:3, 3]
        clouds.append(cloud[(np.abs(q[:, :2] - [-0.15, 0.1]) > 0.05).any(axis=1)])
    smooth = rng.uniform(size=shape) < 0.9
    # nodes that neither points nor smoothing touch
    smooth[:3, :3] = False
    return Case(problem_of(clouds, T), Grid(origin, spacing, shape), State(T, heights), smooth)


def dense_of(lin: Linearisation) -> tuple[Floats, Floats]:
    """Return the whole matrix and gradient of a linearisation, poses first."""
    n, nodes = len(lin.A), lin.g_map.size
    H = np.zeros((6 * n + nodes, 6 * n + nodes))
    for i, foot in enumerate(lin.B):
        window = slice(6 * i, 6 * i + 6)
        H[window, window] = lin.A[i]
        B = np.zeros((*lin.g_map.shape, 6))
        B[foot.window] = foot.values
        H[6 * n :, window] = B.reshape(-1, 6)
        H[window, 6 * n :] = B.reshape(-1, 6).T
    H[6 * n :, 6 * n :] = stencil_dense(lin)
    return H, np.concatenate([lin.g_pose.ravel(), lin.g_map.ravel()])


def stencil_dense(lin: Linearisation) -> Floats:
    """Return C as a dense matrix, entry by entry from its five arrays."""
    C, (ny, nx) = lin.C, lin.g_map.shape
    out = np.zeros((ny, nx, ny, nx))
    for y in range(ny):
        for x in range(nx):
            out[y, x, y, x] = C.own[y, x]
            for value, one, other in (
                (C.right[y, x], (y, x), (y, x + 1)),
                (C.up[y, x], (y, x), (y + 1, x)),
                (C.up_right[y, x], (y, x), (y + 1, x + 1)),
                (C.up_left[y, x], (y, x + 1), (y + 1, x)),
            ):
                if max(one[0], other[0]) < ny and max(one[1], other[1]) < nx:
                    out[(*one, *other)] = out[(*other, *one)] = value
                else:
                    assert value == 0.0
    return out.reshape(ny * nx, ny * nx)
