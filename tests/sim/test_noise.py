from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim.errors import SimulationError
from sim.noise import STAGES, Stage, choose_stages, measure, staged, stated_noise
from sim.sensors import SP1000, ZED2, DepthSensor, find_sensor
from tests.sim.shots import OVER_THE_TABLE, errors_px, floor, shot_of, table

SENSOR = SP1000.resized(320, 240)
SHOT = floor(SENSOR, 2.5)
SENSORS = (SENSOR, ZED2.resized(320, 180))


def only(*names: str) -> tuple[Stage, ...]:
    return tuple(stage for stage in STAGES if stage.name in names)


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: s.model)
@pytest.mark.parametrize("z", [1.2, 2.0, 3.0])
def test_all_noise_of_a_facing_surface_is_what_the_header_says(
    sensor: DepthSensor, z: float
) -> None:
    shot = floor(sensor, 1.0)
    stages = only("fixed-pattern", "disparity-noise", "disparity-steps")
    exact = np.full(shot.hits.distance.shape, z)
    error = np.array([measure(exact, shot, 1, k, stages) for k in range(4)]) - z
    at_1m = sensor.noise.sigma_m / sensor.noise.at_m**2
    assert np.sqrt(np.mean(error**2)) == pytest.approx(at_1m * z**2, rel=0.015)
    px = errors_px(shot, stages, frames=4, z=z)
    assert abs(px.mean()) < 5 * px.std() / np.sqrt(px.size / sensor.window**2)
    assert stated_noise(sensor) == sensor.noise and sensor.noise.along == "z"


def test_the_makers_figures() -> None:
    assert SP1000.noise.sigma(3.0) == pytest.approx(0.00032)
    assert (ZED2.camera.width, ZED2.camera.height, ZED2.baseline) == (1280, 720, 0.12)
    assert ZED2.camera.fx == pytest.approx(528.0)
    assert ZED2.noise.sigma(3.0) < 0.01 * 3.0
    for sensor in (SP1000, ZED2):
        assert sensor.depth_max / sensor.depth_scale < 65535


@pytest.mark.parametrize("sensor", [SP1000, ZED2], ids=lambda s: s.model)
def test_another_image_size_keeps_what_a_pixel_error_means_in_metres(sensor: DepthSensor) -> None:
    small = sensor.resized(320, 240)
    assert small.noise == sensor.noise
    for field in ("pattern", "lateral", "flying", "window"):
        at_1m = getattr(sensor, field) / sensor.focal
        assert getattr(small, field) / small.focal == pytest.approx(at_1m)
    assert small.resized(sensor.width, sensor.height) == sensor


def test_the_header_leaves_out_what_is_switched_off() -> None:
    full = ZED2.disparity_sigma
    assert stated_noise(ZED2, choose_stages(without=("disparity-noise",))) is None
    assert stated_noise(ZED2, choose_stages(clean=True)) is None
    less = stated_noise(ZED2, choose_stages(without=("fixed-pattern", "disparity-steps")))
    assert less is not None
    expected = 0.0016 * np.sqrt(1.0 - (0.03**2 + 0.0625**2 / 12) / full**2)
    assert less.sigma_m == pytest.approx(expected) and less.sigma_m < 0.0016
    shot = floor(SENSORS[1], 1.0)
    error = errors_px(shot, only("disparity-noise"), frames=4, z=1.0).std()
    assert error / full * 4 * 0.0016 == pytest.approx(less.sigma_m, rel=0.015)
    assert stated_noise(ZED2, choose_stages(without=("shadow", "dropout"))) == ZED2.noise


def test_range_limits_and_whole_counts() -> None:
    exact = np.linspace(0.5, 4.0, 240 * 320).reshape(240, 320)
    depth = measure(exact, SHOT, seed=1, frame=0, stages=choose_stages(clean=True))
    inside = (exact >= SENSOR.depth_min) & (exact <= SENSOR.depth_max)
    np.testing.assert_array_equal(np.isfinite(depth), inside)
    assert np.abs(depth - exact)[inside].max() <= 0.5 * SENSOR.depth_scale + 1e-12


def test_frames_and_seeds_have_noise_of_their_own() -> None:
    exact = SHOT.hits.distance
    again = [measure(exact, SHOT, seed=1, frame=4) for _ in range(2)]
    np.testing.assert_array_equal(*again)
    assert not np.array_equal(again[0], measure(exact, SHOT, seed=1, frame=5))
    assert not np.array_equal(again[0], measure(exact, SHOT, seed=2, frame=4))
    steps = staged(exact, SHOT, 1, 4)
    assert [name for name, _ in steps] == [stage.name for stage in STAGES]
    np.testing.assert_array_equal(steps[-1][1], again[0])


def test_a_hole_leaves_the_other_pixels_as_they_were() -> None:
    holes = SHOT.hits.distance.copy()
    holes[::7] = np.nan
    kept = np.isfinite(holes)
    stages = choose_stages(without=("lateral-jitter",))  # which moves holes too
    whole = measure(SHOT.hits.distance, SHOT, 1, 4, stages)
    np.testing.assert_array_equal(measure(holes, SHOT, 1, 4, stages)[kept], whole[kept])


@pytest.mark.parametrize("name", ["fixed-pattern", "disparity-noise", "grazing"])
def test_a_stage_switched_off_leaves_the_draws_of_the_others(name: str) -> None:
    """Errors of the disparity add up, so what is missing must be what the stage does alone."""
    stages = only("fixed-pattern", "disparity-noise", "grazing")
    most = tuple(stage for stage in stages if stage.name != name)
    missing = errors_px(SHOT, stages) - errors_px(SHOT, most)
    np.testing.assert_allclose(missing, errors_px(SHOT, only(name)), atol=1e-12)


def test_dropouts_do_not_hang_on_other_stages() -> None:
    dark = floor(SENSOR, 2.5, grey=0.04)
    alone, late = (
        np.isnan(measure(dark.hits.distance, dark, 1, 0, stages))
        for stages in (only("dropout"), only("disparity-noise", "grazing", "dropout"))
    )
    assert alone.any()
    np.testing.assert_array_equal(alone, late)


def test_a_table_has_some_holes_and_no_more() -> None:
    for size in ((1280, 720), (640, 360)):
        shot = shot_of(table(), ZED2.resized(*size), OVER_THE_TABLE)
        depth = measure(shot.hits.distance, shot, 1, 0)
        assert 0.03 < np.isnan(depth).mean() < 0.10
        plain = np.isfinite(depth) & (shot.hits.distance < 1.5)
        score = (depth - shot.hits.distance) / shot.sensor.noise.sigma(shot.hits.distance)
        assert np.median(np.abs(score[plain])) / 0.6745 == pytest.approx(1.0, abs=0.1)


def test_every_stage_states_its_law_in_one_line() -> None:
    for stage in STAGES:
        for sensor in (SP1000, ZED2, replace(ZED2, disparity_step=None)):
            law = stage.law(sensor)
            assert law and "\n" not in law and len(law) < 60


def test_unknown_names_list_the_choices() -> None:
    with pytest.raises(SimulationError, match=r"'fog'.*shadow, .*disparity-noise, .*quantisation"):
        choose_stages(without=("fog",))
    with pytest.raises(SimulationError, match=r"'zed9'.*sp1000, zed2"):
        find_sensor("zed9")


@pytest.mark.parametrize("z", [1.2, 3.0])
def test_white_noise_is_of_the_stated_sigma_along_the_ray(z: float) -> None:
    stages = choose_stages(white=True)
    assert [stage.name for stage in stages] == ["white-noise", "range-limits", "quantisation"]
    exact = np.full(SHOT.hits.distance.shape, z)
    error = (measure(exact, SHOT, 1, 0, stages[:1]) - z) * np.linalg.norm(
        SENSOR.camera.rays(), axis=-1
    )
    stated = stated_noise(SENSOR, stages)
    assert stated is not None and stated.along == "range"
    assert error.std() == pytest.approx(stated.sigma(z), rel=0.01)
    assert abs(error.mean()) < 5 * error.std() / np.sqrt(error.size)
    for axis in (0, 1):
        beside = np.roll(error, 1, axis)
        assert abs(np.mean(error * beside)) < 0.02 * error.var()
    # In every direction the same: at the rim as in the middle.
    assert error[:40, :40].std() == pytest.approx(error[100:140, 140:180].std(), rel=0.1)
