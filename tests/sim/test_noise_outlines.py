from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from sim.engine import mujoco
from sim.noise import measure
from sim.noise.outlines import FlyingPixels, LateralJitter, Shadow
from sim.noise.shot import Shot
from sim.sensors import SP1000, ZED2, DepthSensor
from tests.sim.shots import OVER_THE_TABLE, G, floor, looking_down, shot_of, table

SP = SP1000.resized(640, 480)

TALL = replace(ZED2, width=64, height=4000, window=1.0)
"""Many rows, each with a fate of its own."""


def holes_of(shot: Shot) -> np.ndarray:
    return np.isnan(measure(shot.hits.distance, shot, 1, 0, (Shadow(),)))


def box_on_floor(sensor: DepthSensor, x: float, height: float, z: float, lift: float = 0.0) -> Shot:
    """A box of 0.4 x 0.6 m at x, seen from z above the floor."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=G.mjGEOM_PLANE, size=[9, 9, 0.1])
    spec.worldbody.add_geom(
        type=G.mjGEOM_BOX, size=[0.2, 0.3, 0.5 * height], pos=[x, 0.0, lift + 0.5 * height]
    )
    return shot_of(spec, sensor, looking_down(z))


@pytest.mark.parametrize("baseline", [0.05, 0.1, 0.15])
@pytest.mark.parametrize("height", [0.1, 0.4])
def test_a_box_casts_a_shadow_as_wide_as_its_disparity_over_the_floors(
    baseline: float, height: float
) -> None:
    """B h / (z - h) on the floor, which is f B h / (z (z - h)) pixels; to the left alone."""
    sensor, z = replace(SP, baseline=baseline), 3.0
    shot = box_on_floor(sensor, 0.0, height, z)
    holes = holes_of(shot)
    width = sensor.focal * baseline * height / (z * (z - height))
    middle = holes[230:250]
    assert np.abs(middle.sum(axis=1) - width).max() < 1.0
    left = np.flatnonzero(shot.hits.geom[240] == 1)[0]
    assert middle[:, left:].sum() == 0
    assert (shot.hits.geom[holes] == 0).all()
    if width > 1.0:
        assert middle[:, left - 1].all()


def test_a_second_camera_misses_a_strip_as_wide_as_the_disparity() -> None:
    sensor = ZED2.resized(640, 360)
    for z in (0.6, 1.2):
        holes = holes_of(floor(sensor, z))
        strip = np.arange(640) < sensor.disparity_at_1m / z - 0.5
        np.testing.assert_array_equal(holes, np.broadcast_to(strip, holes.shape))
        assert not holes_of(floor(replace(sensor, active=True), z)).any()


@pytest.mark.parametrize("degrees", [0.0, 40.0, 80.0, -80.0])
def test_no_surface_hides_itself(degrees: float) -> None:
    tilted = floor(replace(SP, field_of_view=0.15), 2.0, tilt=(0.3, np.radians(degrees)))
    assert np.isfinite(tilted.hits.distance).all()
    assert not holes_of(tilted).any()
    # Of a ball, what faces away from the projector, and nothing else.
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=G.mjGEOM_SPHERE, size=[0.5, 0, 0])
    ball = shot_of(spec, SP, looking_down(2.5))
    v, u = np.nonzero(ball.hits.triangle >= 0)
    rays = ball.rays(v, u) * [1.0, -1.0, -1.0]
    points = ball.T_world_camera[:3, 3] + rays * ball.hits.distance[v, u, None]
    facing = np.einsum("ni,ni->n", points, ball.eye - points) / 0.5
    holes = holes_of(ball)[v, u]
    assert holes.any() and not holes[facing > 0.02].any()
    assert holes[facing < -0.02].all()


@pytest.mark.parametrize("place", ["table", "beside the image"])
def test_rays_are_cast_wherever_one_is_needed(place: str) -> None:
    """Against a ray to each and every pixel."""
    if place == "table":
        shot = shot_of(table(), ZED2.resized(640, 360), OVER_THE_TABLE)
    else:
        # At 1.4 m the view ends at x = 0.81, just before the box.
        shot = box_on_floor(SP, 1.02, 0.01, 3.0, lift=1.6)
        assert (shot.hits.geom == 0).all()
    rays = shot.sensor.camera.rays() @ shot.T_world_camera[:3, :3].T
    points = shot.T_world_camera[:3, 3] + rays * shot.hits.distance[..., None]
    hidden = shot.scene.cast(shot.eye, points - shot.eye).distance < 1.0 - 1e-4
    column = np.arange(shot.sensor.width) - shot.sensor.disparity_at_1m / shot.hits.distance
    expected = hidden | (~np.array(shot.sensor.active) & (column < -0.5))
    assert hidden.sum() > 200
    assert np.mean(expected != holes_of(shot)) < 1e-4


def step_edge(shot: Shot, near: float = 2.0, far: float = 3.0) -> np.ndarray:
    depth = np.full(shot.hits.distance.shape, far)
    depth[:, :30] = near
    return depth


@pytest.mark.parametrize("sigma", [0.8, 0.5])
def test_outlines_are_displaced_as_stated(sigma: float) -> None:
    """A pixel at t from the outline lies beyond it with the normal distribution's share at -t."""
    shot = floor(replace(TALL, lateral=sigma), 2.5)
    for exact in (step_edge(shot), step_edge(shot, far=np.nan)):
        depth = measure(exact, shot, 1, 0, (LateralJitter(),))
        crossed = ~((depth == exact) | (np.isnan(depth) & np.isnan(exact)))
        share = crossed.mean(axis=0)
        expected = ndtr(-(np.abs(np.arange(64) - 29.5)) / sigma)
        np.testing.assert_allclose(share, expected, atol=4 * np.sqrt(0.25 / 4000))
        assert np.isin(depth[crossed & np.isfinite(depth)], [2.0, 3.0]).all()


def test_jitter_and_mixing_leave_surfaces_alone() -> None:
    shot = floor(replace(SP1000, lateral=0.8, flying=3.0).resized(640, 480), 2.5, tilt=(0.6, 0.5))
    exact = shot.hits.distance
    assert np.isfinite(exact).all()
    for stage in (LateralJitter(), FlyingPixels()):
        np.testing.assert_array_equal(measure(exact, shot, 1, 0, (stage,)), exact)


@pytest.mark.parametrize("width", [1.0, 3.0])
def test_flying_pixels_lie_between_the_two_sides_of_an_outline(width: float) -> None:
    """An outline at t from a pixel takes (w/2 - t) / w of its footprint."""
    shot = floor(replace(TALL, flying=width), 2.5)
    exact = step_edge(shot)
    depth = measure(exact, shot, 1, 0, (FlyingPixels(),))
    moved = depth != exact
    assert (depth >= 2.0).all() and (depth <= 3.0).all()
    away = np.maximum(29 - np.arange(64), np.arange(64) - 30)  # whole pixels before the outline
    share = np.clip(0.5 * width - away, 0.0, 1.0)
    np.testing.assert_allclose(moved.mean(axis=0), share, atol=4 * np.sqrt(0.25 / 4000))
    for column in (29, 30):
        mixed = np.abs(depth - exact)[moved[:, column], column]
        low, high = max(0.0, 0.5 - 1.0 / width), 0.5
        assert low <= mixed.min() and mixed.max() <= high
        assert mixed.mean() == pytest.approx(0.5 * (low + high), rel=0.05)


def test_nothing_flies_between_a_surface_and_a_hole() -> None:
    shot = floor(TALL, 2.5)
    exact = step_edge(shot, far=np.nan)
    np.testing.assert_array_equal(measure(exact, shot, 1, 0, (FlyingPixels(),)), exact)
