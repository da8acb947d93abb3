"""Frames of plain surfaces, for the tests of the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sim.engine import mujoco
from sim.noise import Stage, measure
from sim.noise.shot import Shot
from sim.rendering.raycast import RayScene
from sim.rendering.shading import Finish
from sim.sensors import DepthSensor

G = mujoco.mjtGeom


def shot_of(spec: mujoco.MjSpec, sensor: DepthSensor, T_world_camera: np.ndarray) -> Shot:
    model = spec.compile()
    scene = RayScene.of_model(model)
    hits = scene.view(sensor.camera, T_world_camera)
    return Shot(sensor, scene, Finish.of_model(model), T_world_camera, hits)


def looking_down(height: float) -> np.ndarray:
    """A pose above the origin: camera x is world x."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = height
    return T


def look_at(eye: tuple[float, ...], target: tuple[float, ...]) -> np.ndarray:
    z = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, 3] = eye
    return T


def floor(
    sensor: DepthSensor,
    height: float,
    tilt: tuple[float, float] = (0.0, 0.0),
    grey: float = 1.0,
    gloss: float = 0.0,
) -> Shot:
    """A wide floor seen from straight above, turned by `tilt` about the world's x and y, rad."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.add_material(name="finish", specular=gloss, shininess=1.0, rgba=[grey, grey, grey, 1.0])
    spec.worldbody.add_geom(
        type=G.mjGEOM_PLANE,
        size=[40, 40, 0.1],
        rgba=[grey, grey, grey, 1.0],
        material="finish",
        euler=[*tilt, 0.0],
    )
    return shot_of(spec, sensor, looking_down(height))


def narrow(sensor: DepthSensor, degrees: float = 2.0) -> DepthSensor:
    """The sensor through a tele lens: one viewing angle everywhere."""
    return replace(sensor, field_of_view=np.radians(degrees))


def errors_px(
    shot: Shot, stages: tuple[Stage, ...], seed: int = 1, frames: int = 1, z: float | None = None
) -> np.ndarray:
    """Errors (frames, height, width) of the disparity, pixels, of a scene or of a constant z."""
    exact = shot.hits.distance if z is None else np.full(shot.hits.distance.shape, z)
    depth = np.array([measure(exact, shot, seed, k, stages) for k in range(frames)])
    return shot.sensor.disparity_at_1m * (1.0 / depth - 1.0 / exact)


def table() -> mujoco.MjSpec:
    """Boxes, a ball and cylinders on a table: wood, paint, steel, chrome and black."""
    spec = mujoco.MjSpec()
    spec.add_material(name="steel", specular=0.8, shininess=0.625, rgba=[0.65, 0.65, 0.65, 1])
    spec.add_material(name="chrome", specular=0.9, shininess=0.9, rgba=[0.7, 0.7, 0.7, 1])

    def add(kind: G, size: list[float], pos: list[float], rgb: list[float], material: str = ""):
        spec.worldbody.add_geom(
            type=kind, size=size, pos=pos, rgba=[*rgb, 1.0], material=material
        )  # fmt: skip

    add(G.mjGEOM_PLANE, [9, 9, 0.1], [0, 0, -0.7], [0.4, 0.4, 0.4])
    add(G.mjGEOM_BOX, [1.2, 0.6, 0.02], [0, 0.4, -0.02], [0.6, 0.5, 0.35])
    add(G.mjGEOM_BOX, [0.1, 0.06, 0.05], [-0.2, 0.45, 0.05], [0.7, 0.3, 0.2])
    add(G.mjGEOM_CYLINDER, [0.05, 0.1, 0], [0.15, 0.5, 0.1], [0.65, 0.65, 0.67], "steel")
    add(G.mjGEOM_SPHERE, [0.07, 0, 0], [0, 0.3, 0.07], [0.7, 0.7, 0.7], "chrome")
    add(G.mjGEOM_BOX, [0.05, 0.08, 0.06], [-0.4, 0.3, 0.06], [0.02, 0.02, 0.02])
    add(G.mjGEOM_CYLINDER, [0.015, 0.12, 0], [-0.05, 0.62, 0.12], [0.2, 0.5, 0.3])
    return spec


OVER_THE_TABLE = look_at((0.1, -0.05, 0.75), (0.0, 0.45, 0.0))
