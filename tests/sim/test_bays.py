"""The three bays: their one floor, and what stands on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sim.engine import mujoco
from sim.markers import discs_of, observe
from sim.rendering.raycast import RayScene, world_rays
from sim.rendering.shading import Finish
from sim.rigs.gantry import Gantry
from sim.scenes import find_scene
from sim.scenes.ground import make_ground
from sim.scenes.industrial import industrial_4
from sim.scenes.stones import CRUSHED, Keep, draw_diameters, make_shapes, scatter
from sim.scenes.workpieces import Coil, coil
from sim.seeds import stream
from sim.sensors import SP1000


@dataclass(frozen=True)
class Bay:
    """One of the three scenes at one seed."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    data: mujoco.MjData
    rays: RayScene

    def named(self, prefix: str) -> list[int]:
        return [k for k in range(self.model.ngeom) if self.model.geom(k).name.startswith(prefix)]

    def pose(self, geom: int) -> tuple[np.ndarray, np.ndarray]:
        return self.data.geom_xpos[geom], self.data.geom_xmat[geom].reshape(3, 3)

    def gap(self, first: int, second: int) -> float:
        return mujoco.mj_geomDistance(self.model, self.data, first, second, 1.0, np.zeros(6))


@pytest.fixture(scope="module")
def bays() -> dict[int, Bay]:
    found = {}
    for number in (4, 5, 6):
        spec = find_scene(f"industrial-{number}").build(3)
        model = mujoco.MjModel.from_xml_string(spec.to_xml(), dict(spec.assets))
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        found[number] = Bay(spec, model, data, RayScene.of_model(model, data))
    return found


def floor_of(spec: mujoco.MjSpec) -> dict[str, tuple]:
    """Every stone and piece of scrap: its shape, pose and colour, to the last digit."""
    return {
        geom.name: (
            tuple(spec.mesh(geom.meshname).uservert) if geom.meshname else tuple(geom.size),
            *geom.pos, *geom.quat, *geom.rgba, geom.material,
        )
        for geom in spec.worldbody.geoms
        if geom.name.startswith(("loose_stone", "loose_boulder", "scrap_"))
    }  # fmt: skip


def test_the_floor_is_the_same_in_all_three(bays: dict[int, Bay]) -> None:
    floors = [floor_of(bays[number].spec) for number in (4, 5, 6)]
    assert len(floors[0]) > 1200 and floors[0] == floors[1] == floors[2]
    heights = [bays[number].model.hfield_data for number in (4, 5, 6)]
    assert np.array_equal(heights[0], heights[1]) and np.array_equal(heights[0], heights[2])
    assert not set(floors[0].values()) & set(floor_of(industrial_4(4)).values())


def test_a_place_kept_clear_leaves_the_other_stones_alone() -> None:
    floors = []
    for keep in ((), (Keep(3.0, 3.0, 1.0, above=0.07),)):
        spec, rng = mujoco.MjSpec(), stream(0, "kept")
        shapes = make_shapes(spec, rng, CRUSHED, np.array([0.05, 0.1, 0.2, 0.3]), 3)
        diameters = draw_diameters(rng, 700, 0.05, 0.34, 1.7)
        relief = make_ground(stream(0, "ground"), (-0.5, 6.5, -0.5, 6.5), 0.025, ())
        scatter(spec, rng, relief, shapes, diameters, (0.0, 6.0, 0.0, 6.0), keep)
        floors.append({geom.name: geom for geom in spec.worldbody.geoms})
    whole, cleared = floors
    far = [name for name, g in whole.items() if np.hypot(g.pos[0] - 3.0, g.pos[1] - 3.0) > 1.8]
    same = [
        name in cleared
        and whole[name].meshname == cleared[name].meshname
        and np.allclose(whole[name].pos, cleared[name].pos, rtol=0.0, atol=1e-12)
        and np.allclose(whole[name].quat, cleared[name].quat, rtol=0.0, atol=1e-12)
        and np.array_equal(whole[name].rgba, cleared[name].rgba)
        for name in far
    ]
    assert len(far) > 400 and len(cleared) < len(whole) - 10
    assert np.mean(same) > 0.95


@pytest.mark.parametrize("number", [4, 5, 6])
def test_all_is_in_range_and_the_markers_in_sight(bays: dict[int, Bay], number: int) -> None:
    bay, sensor = bays[number], SP1000.resized(320, 240)
    seen = {disc.name: 0 for disc in discs_of(bay.model, bay.data)}
    for T in Gantry().track(bay.model, 0, scale=0.0).T_world_camera_true:
        hits = bay.rays.view(sensor.camera, T)
        assert sensor.depth_min < hits.distance.min() and hits.distance.max() < sensor.depth_max
        for disc in discs_of(bay.model, bay.data):
            seen[disc.name] += observe(disc, sensor.camera, T, hits, hits.distance) is not None
    assert set(seen) == {"origin", "far_x", "far_y"} and min(seen.values()) >= 2


def test_heaps_keep_to_the_angle_of_repose(bays: dict[int, Bay]) -> None:
    assert steepest(bays[6].rays) < 40.0


def test_metal_shines_and_stone_does_not(bays: dict[int, Bay]) -> None:
    for bay in bays.values():
        gloss = Finish.of_model(bay.model).gloss
        assert (gloss[bay.named(("slab_", "coil_", "plate_"))] > 0.3).all()
        crushed = [k for k in bay.named("loose_") if bay.model.geom_matid[k] < 0]
        slag = [k for k in bay.named("loose_") if bay.model.geom_matid[k] >= 0]
        assert len(crushed) > len(slag) > 100
        assert (gloss[crushed] == 0.0).all() and (np.abs(gloss[slag] - 0.1) < 0.05).all()
        assert {round(g, 2) for g in gloss[bay.named("scrap_")]} == {0.08, 0.4}


def test_the_slab_is_flat_and_lies_level(bays: dict[int, Bay]) -> None:
    bay = bays[4]
    (slab,) = bay.named("slab_")
    centre, R = bay.pose(slab)
    half = bay.model.geom_size[slab]
    assert (2 * half >= [1.8, 0.9, 0.18]).all() and (2 * half <= [2.2, 1.1, 0.25]).all()
    assert np.degrees(np.arccos(R[2, 2])) < 3.0
    u, v = np.meshgrid(*(np.linspace(-0.99, 0.99, 60) * h for h in half[:2]))
    above = centre + np.stack([u, v, np.full_like(u, 1.0)], axis=-1) @ R.T
    hits = bay.rays.cast(above, np.broadcast_to(-R[:, 2], above.shape))
    top = hits.geom == slab
    assert top.mean() > 0.75  # the rest is scale, chips and what leans on it
    np.testing.assert_allclose(hits.distance[top], 1.0 - half[2], atol=1e-6)


def test_billets_are_straight_and_rest_on_something(bays: dict[int, Bay]) -> None:
    bay = bays[4]
    bars = [k for k in bay.named("billet_") if bay.model.geom(k).name.endswith("_0")]
    solid = bars + bay.named("slab_")
    assert len(bars) == 5
    lean = []
    for bar in bars:
        centre, R = bay.pose(bar)
        half = bay.model.geom_size[bar]
        assert 1.19 < 2 * half[0] < 2.0 and 0.12 <= 2 * half[1] <= 0.16 and half[1] == half[2]
        along = np.linspace(-0.98, 0.98, 200) * half[0]
        above = centre + R[:, 2] * 0.5 + along[:, None] * R[:, 0]
        hits = bay.rays.cast(above, np.broadcast_to(-R[:, 2], above.shape))
        seen = hits.geom == bar
        assert seen.mean() > 0.5
        np.testing.assert_allclose(hits.distance[seen], 0.5 - half[2], atol=1e-6)
        assert min(bay.gap(bar, other) for other in solid if other != bar) > -0.003
        # What carries it is near on both sides of its middle.
        u, v = np.meshgrid(np.linspace(-1, 1, 161) * half[0], np.linspace(-1, 1, 9) * half[1])
        below = centre + np.stack([u, v, np.full_like(u, -half[2] - 1e-4)], axis=-1) @ R.T
        under = bay.rays.cast(below, np.broadcast_to([0.0, 0.0, -1.0], below.shape)).distance
        assert u[under < 0.008].min() < -0.05 and u[under < 0.008].max() > 0.05
        lean.append(np.degrees(np.arcsin(abs(R[2, 0]))))
    assert max(lean) > 4.0 and sorted(lean)[2] < 3.0  # some lie, one leans


def test_the_coil_is_round_and_lies_between_its_timbers(bays: dict[int, Bay]) -> None:
    bay = bays[5]
    strip, timbers = bay.model.geom("coil_0").id, bay.named("timber_")
    axis = bay.pose(timbers[0])[1][:, 0]
    assert abs(axis[2]) < 0.05 and len(timbers) == 2
    radius = np.linalg.norm(piece_of(3).strip.vertices[:, :2], axis=1).max()
    assert 0.45 <= radius <= 0.65
    camera, points = SP1000.resized(640, 480).camera, []
    for T in Gantry().track(bay.model, 0, scale=0.0).T_world_camera_true:
        hits = bay.rays.view(camera, T)
        on = (hits.geom == strip) & (np.abs(bay.rays.normals[hits.triangle] @ axis) < 1e-3)
        points.append(T[:3, 3] + world_rays(camera, T)[on] * hits.distance[on][:, None])
    p = np.concatenate(points) - bay.pose(strip)[0]
    across = np.cross(axis, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    flat = np.column_stack([p @ across, p @ np.cross(across, axis)])
    flat = flat[np.linalg.norm(flat, axis=1) > radius - 0.002]  # not the inner turns' edges
    assert len(flat) > 20_000
    A = np.column_stack([2.0 * flat, np.ones(len(flat))])
    (x, y, c), *_ = np.linalg.lstsq(A, (flat**2).sum(axis=1), rcond=None)
    fitted = np.sqrt(c + x * x + y * y)
    assert fitted == pytest.approx(radius, abs=2e-5)
    assert np.abs(np.linalg.norm(flat - [x, y], axis=1) - fitted).max() < 1e-4
    for timber in timbers:
        assert abs(bay.gap(strip, timber)) < 2e-3


def piece_of(seed: int) -> Coil:
    return coil(stream(seed, "industrial-5", "coil"))


def test_the_coils_ends_show_its_turns_and_its_bore(bays: dict[int, Bay]) -> None:
    bay, piece = bays[5], piece_of(3)
    low, high = piece.strip.vertices.min(axis=0), piece.strip.vertices.max(axis=0)
    radius = np.linalg.norm(piece.strip.vertices[:, :2], axis=1)
    assert 0.49 < 2 * radius.min() < 0.53 and 0.8 <= high[2] - low[2] <= 1.1
    start = bay.data.geom_xpos[bay.model.geom("coil_0").id]
    _, R = bay.pose(bay.model.geom("timber_0").id)
    across = np.linspace(radius.min() + 0.01, radius.max() - 0.01, 80)
    begin = start + R @ [2.0, 0.013, 0.0] + across[:, None] * R[:, 2]
    hits = bay.rays.cast(begin, np.broadcast_to(-R[:, 0], begin.shape))
    assert (hits.geom == bay.model.geom("coil_0").id).all()
    steps = np.abs(np.diff(hits.distance))
    assert (steps > 1e-3).sum() >= 5 and steps.max() < 0.03
    through = bay.rays.cast(start + R[:, 0] * 2.0, -R[:, 0])
    assert int(through.geom) != bay.model.geom("coil_0").id


def steepest(rays: RayScene) -> float:
    """The steepest slope of the surface seen from above, smoothed over the stones, degrees."""
    x, y = np.arange(-1.2, 8.2, 0.05), np.arange(-0.9, 6.9, 0.05)
    above = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), 5.0)], axis=-1)
    down = np.broadcast_to([0.0, 0.0, -1.0], above.shape)
    z = gaussian_filter(5.0 - rays.cast(above, down).distance, 0.15 / 0.05)
    return float(np.degrees(np.arctan(np.hypot(*np.gradient(z, 0.05)).max())))
