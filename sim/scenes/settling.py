"""Physics as an option: what lies loose in a scene falls, comes to rest and is fixed there.

Loose are the bodies with a free joint, and the world's geoms called `loose_*`, which are convex.
They fall in layers, each onto what already lies: far fewer contacts at a time than a whole heap
has, and what has come to rest sleeps and costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.engine import mujoco
from sim.errors import SimulationError
from sim.markers import discs_of
from sim.rendering.raycast import RayScene
from sim.rendering.tessellate import triangles_of
from sim.scenes.relief import Relief, hull_of, turned
from sim.scenes.stones import LOOSE

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Settling:
    """How things fall. Equal values give equal poses."""

    layer: int = 200
    """How many fall at the same time."""
    timestep: float = 0.004
    """s."""
    seconds: float = 4.0
    """Of simulated time for a layer; what still rolls then is fixed where it is."""
    at_rest: float = 0.004
    """Speed below which a thing is at rest, m/s."""
    friction: tuple[float, float, float] = (0.9, 0.01, 0.004)
    """Of loose stones: sliding (a coefficient), spinning and rolling (m)."""
    clearance: float = 0.004
    """Gap at which loose geoms start above what they lie on, m."""
    spacing: float = 0.01
    """Of the height raster that says where that is, m; coarser where it would be too large."""
    in_sight: float = float(np.radians(42.0))
    """How far from upright a marker is to be seen, rad."""


@dataclass(eq=False)
class _Stone:
    """A loose geom; its shape is that of its convex hull."""

    index: int
    """Among the geoms of the world."""
    planes: Array
    """(k, 4) of its hull, about its origin in world axes."""
    radius: float
    """Of the sphere about its origin that holds it, m."""
    height: float
    position: Array
    rotation: Array


def settle(spec: mujoco.MjSpec, how: Settling = Settling()) -> mujoco.MjSpec:
    """A copy of a scene in which nothing is loose: all that was has fallen and lies still.

    Everything else stays where it is. A loose geom may overlap what it is bedded in: it starts
    just above. One that lies under something fixed, that rolls off the edge or into a marker's
    view, is taken out. SimulationError names a body that nothing stops.
    """
    # The text has every frame, default and orientation resolved.
    still = mujoco.MjSpec.from_string(spec.to_xml(), assets=dict(spec.assets))
    for key in list(still.keys):
        still.delete(key)
    model, data = _compiled(still)
    stones, bodies = _stones_of(still, model, data), _free_bodies(still, data)
    out: list[int] = []
    relief = Relief(np.zeros((2, 2)), (0.0, 0.0), 1.0)
    if stones:
        relief = _relief_of(still, model, data, stones, how)
        rises = [_rise(relief, stone) for stone in stones]
        free = [rise < stone.height for rise, stone in zip(rises, stones, strict=True)]
        out = [stone.index for stone, falls in zip(stones, free, strict=True) if not falls]
        stones = [stone for stone, falls in zip(stones, free, strict=True) if falls]
    lowest, fallen = float(relief.z.min()) - 1.0, []
    while stones or bodies:
        layer, stones = stones[: how.layer], stones[how.layer :]
        room = how.layer - len(layer)
        dropped, bodies = bodies[:room], bodies[room:]
        _lift(relief, layer, how)
        absent = out + [stone.index for stone in stones]
        _fall(still, layer, dropped, absent, bodies, how)
        out += [stone.index for stone in layer if stone.position[2] < lowest]
        for stone in layer:
            x, y, z = stone.position
            relief.raise_to(stone.planes, x, y, z, stone.radius)
        fallen += layer
    while covering := _in_sight(still, out, how):
        out += covering
        gone = [stone for stone in fallen if stone.index in covering]
        fallen = [stone for stone in fallen if stone.index not in out]
        _fall(still, [stone for stone in fallen if _near(stone, gone)], [], out, [], how)
    geoms = list(still.worldbody.geoms)
    for index in out:
        still.delete(geoms[index])
    return still


def _compiled(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data


def _free_bodies(spec: mujoco.MjSpec, data: mujoco.MjData) -> list[int]:
    """Which of the world's bodies have a free joint, lowest first."""
    free = [
        k
        for k, body in enumerate(spec.worldbody.bodies)
        if any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints)
    ]
    heights = [float(data.xpos[spec.worldbody.bodies[k].id, 2]) for k in free]
    return [free[k] for k in np.argsort(heights, kind="stable")]


def _stones_of(spec: mujoco.MjSpec, model: mujoco.MjModel, data: mujoco.MjData) -> list[_Stone]:
    """The loose geoms in the order in which the scene lists, that is: piled them."""
    geoms = list(spec.worldbody.geoms)
    loose = [k for k, geom in enumerate(geoms) if geom.name.startswith(LOOSE)]
    triangles = triangles_of(model, data, groups=tuple(range(6)), segments=32)
    order = np.argsort(triangles.geom, kind="stable")
    stones = []
    for k in loose:
        number = geoms[k].id
        first, last = np.searchsorted(triangles.geom, [number, number + 1], sorter=order)
        corners = triangles.vertices[np.unique(triangles.faces[order[first:last]])]
        position, rotation = np.array(geoms[k].pos, float), np.empty(9)
        mujoco.mju_quat2Mat(rotation, geoms[k].quat)
        hull = hull_of(corners - position)
        reach = float(np.linalg.norm(hull.vertices, axis=1).max())
        height = float(np.ptp(hull.vertices[:, 2]))
        stones.append(_Stone(k, hull.planes, reach, height, position, rotation.reshape(3, 3)))
    return stones


def _relief_of(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    stones: list[_Stone],
    how: Settling,
) -> Relief:
    """The highest surface of what is fixed, wherever stones lie."""
    geoms = list(spec.worldbody.geoms)
    model.geom_group[[geoms[s.index].id for s in stones]] = 5
    fixed = RayScene.of_model(model, data, groups=(0, 1, 2, 3, 4))
    places = np.array([s.position[:2] for s in stones])
    reach = max(s.radius for s in stones) + 0.1
    low, high = places.min(axis=0) - reach, places.max(axis=0) + reach
    spacing = max(how.spacing, float(np.sqrt(np.prod(high - low) / 2e6)))
    x, y = (np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True))
    top = float(fixed.triangles.vertices[:, 2].max()) + 1.0
    origins = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), top)], axis=-1)
    down = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
    z = top - fixed.cast(origins, down).distance
    if np.isnan(z).all():
        raise SimulationError("loose geoms: nothing fixed lies under them; expected a floor")
    return Relief(np.where(np.isnan(z), np.nanmin(z), z), (float(low[0]), float(low[1])), spacing)


def _rise(relief: Relief, stone: _Stone) -> float:
    """How far a stone has to be lifted to lie on the relief, m."""
    x, y, z = stone.position
    return relief.bed(stone.planes, x, y, stone.radius, sink=0.0, raising=False) - z


def _lift(relief: Relief, stones: list[_Stone], how: Settling) -> None:
    """Raise stones until they lie clear of the relief and of each other."""
    pile = Relief(relief.z.copy(), relief.origin, relief.spacing)
    for stone in stones:
        x, y, _ = stone.position
        z = pile.bed(stone.planes, x, y, stone.radius, sink=0.0) + how.clearance
        stone.position = np.array([x, y, z])


def _near(stone: _Stone, others: list[_Stone]) -> bool:
    """Whether a stone may touch one of the others."""
    return any(
        np.linalg.norm(stone.position - other.position) < stone.radius + other.radius
        for other in others
    )


def _take_away(spec: mujoco.MjSpec, geoms: list[int], bodies: list[int]) -> None:
    """Let nothing collide with these geoms and bodies of the world: quicker than deleting them."""
    world, roots = list(spec.worldbody.geoms), list(spec.worldbody.bodies)
    for geom in [world[k] for k in geoms] + [g for k in bodies for g in roots[k].find_all("geom")]:
        geom.contype = geom.conaffinity = 0


def _fall(
    still: mujoco.MjSpec,
    stones: list[_Stone],
    bodies: list[int],
    absent: list[int],
    later: list[int],
    how: Settling,
) -> None:
    """Let stones and bodies fall from where they are, and fix them in `still` where they end up.

    `absent` are the geoms of the world, `later` its bodies that they do not meet.
    """
    work = still.copy()
    geoms, roots = list(work.worldbody.geoms), list(work.worldbody.bodies)
    falling = [roots[k] for k in bodies]
    _lock(work, falling)
    _take_away(work, absent + [stone.index for stone in stones], later)
    for stone in stones:
        geom = geoms[stone.index]
        body = work.worldbody.add_body(pos=stone.position, quat=geom.quat)
        body.add_freejoint()
        body.add_geom(
            type=geom.type, meshname=geom.meshname, size=geom.size, friction=how.friction, condim=6
        )
        falling.append(body)
    _tune(work, how)
    model, data = _compiled(work)
    while data.time < how.seconds:
        mujoco.mj_step(model, data)
        if data.ntree_awake == 0:
            break
    mujoco.mj_kinematics(model, data)
    ids = [body.id for body in falling]
    there = list(still.worldbody.bodies)
    for k, number in zip(bodies, ids[: len(bodies)], strict=True):
        if data.qvel[model.body_dofadr[number] + 2] < -3.0:
            raise SimulationError(
                f"body {there[k].name or k!r}: still falls after {data.time:.1f} s; expected "
                "something fixed under it"
            )
        there[k].pos, there[k].quat = data.xpos[number], data.xquat[number]
        for joint in list(there[k].joints):
            still.delete(joint)
    lying = list(still.worldbody.geoms)
    for stone, number in zip(stones, ids[len(bodies) :], strict=True):
        rotation = data.xmat[number].reshape(3, 3).copy()
        stone.planes = turned(stone.planes, rotation @ stone.rotation.T)
        stone.position, stone.rotation = data.xpos[number].copy(), rotation
        lying[stone.index].pos, lying[stone.index].quat = data.xpos[number], data.xquat[number]


def _tune(spec: mujoco.MjSpec, how: Settling) -> None:
    """Large steps and few iterations: only where things come to rest matters."""
    option = spec.option
    option.timestep = how.timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.iterations = 10
    option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    option.sleep_tolerance = how.at_rest


def _lock(spec: mujoco.MjSpec, free: list[mujoco.MjsBody]) -> None:
    """Take out all joints but those of the bodies `free`, and first what may refer to them."""
    kept = {joint.id for body in free for joint in body.joints}
    joints = [joint for joint in spec.joints if joint.id not in kept]
    kinds = (spec.sensors, spec.actuators, spec.equalities, spec.tendons, joints)
    for element in [element for kind in kinds for element in kind]:
        spec.delete(element)


def _in_sight(spec: mujoco.MjSpec, out: list[int], how: Settling) -> list[int]:
    """The loose geoms between a marker's disc and whoever looks at it from above.

    `out` are geoms of the world that do not count.
    """
    model, data = _compiled(spec)
    geoms = list(spec.worldbody.geoms)
    model.geom_group[[geoms[k].id for k in out]] = 5
    loose = {g.id: k for k, g in enumerate(geoms) if g.name.startswith(LOOSE)}
    discs = discs_of(model, data)
    if not discs or not loose:
        return []
    rays = RayScene.of_model(model, data, groups=(0, 1, 2, 3, 4))
    turn = 2.0 * np.pi * np.arange(48) / 48
    ring = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(48)])
    lean = np.tan(how.in_sight) * np.linspace(0.0, 1.0, 6)
    towards = np.concatenate([np.array([0.0, 0.0, 1.0]) + k * ring for k in lean])
    met: set[int] = set()
    for disc in discs:
        rim = np.concatenate([ring[::4] * disc.radius, np.zeros((1, 3))])
        start = disc.p_world + 1e-4 * disc.normal + rim[:, None]
        fan = np.broadcast_to(towards, (len(rim), *towards.shape))
        found = rays.cast(np.broadcast_to(start, fan.shape), fan).geom
        met |= set(np.unique(found).tolist())
    return [loose[number] for number in sorted(met & loose.keys())]
