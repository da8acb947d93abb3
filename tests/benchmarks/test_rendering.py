"""A clean view of 1280 x 720 pixels and its colours, beside Embree's single rays in the same run.

Times are of this process's CPU: other processes do not count, though they take the caches.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from depthba.camera import Camera
from sim.engine import mujoco
from sim.rendering.embree import Singles
from sim.rendering.raycast import RayScene, world_rays
from sim.rendering.shading import Painter

CAMERA = Camera(1280, 720, 528.0, 528.0, 639.5, 359.5)
T_WORLD_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])
T_WORLD_CAMERA[2, 3] = 3.0


def rough_ground(triangles: int) -> mujoco.MjModel:
    """A height field of so many triangles and 300 stones on it."""
    spec, rng = mujoco.MjSpec(), np.random.default_rng(0)
    n = round((triangles / 2) ** 0.5)
    y, x = np.mgrid[:n, :n] / n
    heights = 0.4 + 0.1 * np.sin(9 * x) * np.cos(7 * y) + 0.01 * rng.random((n, n))
    spec.add_hfield(
        name="ground", nrow=n, ncol=n, size=[3, 3, 0.5, 0.1],
        userdata=heights.astype(np.float32).ravel(),
    )  # fmt: skip
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground")
    for k in range(300):
        corners = rng.normal(size=(24, 3)) * rng.uniform(0.02, 0.1)
        spec.add_mesh(
            name=f"stone{k}", uservert=corners.ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
        )  # fmt: skip
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"stone{k}",
            pos=[*rng.uniform(-2.5, 2.5, 2), 0.25],
        )  # fmt: skip
    return spec.compile()


def least_seconds(work: Callable[[], object], rounds: int = 7) -> float:
    work()
    seconds = []
    for _ in range(rounds):
        began = time.process_time()
        work()
        seconds.append(time.process_time() - began)
    return min(seconds)


@pytest.mark.parametrize("triangles", [220_000, 2_000_000])
def test_view(benchmark: BenchmarkFixture, triangles: int) -> None:
    model = rough_ground(triangles)
    began = time.process_time()
    scene = RayScene.of_model(model)
    built = time.process_time() - began
    painter = Painter(scene, model)
    single = Singles(
        scene.triangles.vertices.astype(np.float32), scene.triangles.faces.astype(np.int32)
    )
    origins = np.tile(T_WORLD_CAMERA[:3, 3].astype(np.float32), (CAMERA.width * CAMERA.height, 1))
    rays = world_rays(CAMERA, T_WORLD_CAMERA).reshape(-1, 3).astype(np.float32)
    hits = scene.view(CAMERA, T_WORLD_CAMERA)
    alone = least_seconds(lambda: single.first(origins, rays))
    seconds = least_seconds(lambda: scene.view(CAMERA, T_WORLD_CAMERA))
    painted = least_seconds(lambda: painter.paint(CAMERA, T_WORLD_CAMERA, hits))
    benchmark(scene.view, CAMERA, T_WORLD_CAMERA)
    benchmark.extra_info["times Embree's single rays"] = round(seconds / alone, 2)
    print(
        f"\n{len(scene.triangles.faces)} triangles: view {1e3 * seconds:.0f} ms, "
        f"{seconds / alone:.2f} x Embree's single rays ({1e3 * alone:.0f} ms); "
        f"colours {1e3 * painted:.0f} ms; built in {built:.1f} s"
    )
