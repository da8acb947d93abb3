from __future__ import annotations

import numpy as np
import pytest

from sim.engine import mujoco
from sim.errors import SimulationError
from sim.noise import STAGES, choose_stages, measure
from sim.noise.shot import Shot
from sim.raycast import RayScene
from sim.sensors import SP1000, find_sensor
from sim.shading import Finish

SENSOR = SP1000.resized(320, 240)


def look_down(height: float) -> Shot:
    """A frame of a bare floor, seen from straight above."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9, 9, 0.1])
    model = spec.compile()
    scene, T = RayScene.of_model(model), np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = height
    return Shot(SENSOR, scene, Finish.of_model(model), T, scene.view(SENSOR.camera, T))


SHOT = look_down(2.5)


@pytest.mark.parametrize("z", [1.2, 2.0, 3.0])
def test_range_noise_grows_with_the_square_of_depth(z: float) -> None:
    depth = measure(np.full((240, 320), z), SHOT, seed=1, frame=0, stages=STAGES[:1])
    error = (depth - z) * np.linalg.norm(SENSOR.camera.rays(), axis=-1)
    assert error.std() == pytest.approx(0.00032 * (z / 3.0) ** 2, rel=0.02)
    assert abs(error.mean()) < 5 * error.std() / np.sqrt(error.size)


def test_range_limits_and_whole_counts() -> None:
    exact = np.linspace(0.5, 4.0, 240 * 320).reshape(240, 320)
    depth = measure(exact, SHOT, seed=1, frame=0, stages=choose_stages(clean=True))
    inside = (exact >= SENSOR.depth_min) & (exact <= SENSOR.depth_max)
    np.testing.assert_array_equal(np.isfinite(depth), inside)
    assert np.abs(depth - exact)[inside].max() <= 0.5 * SENSOR.depth_scale + 1e-12
    assert SENSOR.depth_max / SENSOR.depth_scale < 65535


def test_stages_draw_from_streams_of_their_own() -> None:
    flat = np.full((240, 320), 2.5)
    again = [measure(flat, SHOT, seed=1, frame=4) for _ in range(2)]
    np.testing.assert_array_equal(*again)
    assert not np.array_equal(again[0], measure(flat, SHOT, seed=1, frame=5))
    assert not np.array_equal(again[0], measure(flat, SHOT, seed=2, frame=4))
    holes = flat.copy()
    holes[::7] = np.nan
    kept = np.isfinite(holes)
    np.testing.assert_array_equal(measure(holes, SHOT, 1, 4)[kept], again[0][kept])
    coarse = measure(flat, SHOT, 1, 4, choose_stages(without=("quantisation",)))
    assert 0 < np.abs(coarse - again[0]).max() <= 0.5 * SENSOR.depth_scale + 1e-12


def test_unknown_names_list_the_choices() -> None:
    with pytest.raises(SimulationError, match=r"'fog'.*range-noise, range-limits, quantisation"):
        choose_stages(without=("fog",))
    with pytest.raises(SimulationError, match=r"'zed9'.*sp1000"):
        find_sensor("zed9")
