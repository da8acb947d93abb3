from __future__ import annotations

import numpy as np
import pytest

from sim.noise import measure
from sim.noise.disparity import DisparityNoise, DisparitySteps, FixedPattern, Grazing
from sim.sensors import SP1000, ZED2, DepthSensor
from tests.sim.shots import errors_px, floor, narrow

ZED = ZED2.resized(320, 180)
SP = SP1000.resized(320, 240)


def correlation(noise: np.ndarray, lag: int, axis: int) -> float:
    a = np.moveaxis(noise, axis, 0)
    return float(np.mean(a[lag:] * a[: len(a) - lag]) / np.mean(a**2))


def test_noise_is_alike_over_the_matching_window() -> None:
    """Two windows of w pixels share 1 - k / w of them at a distance of k."""
    noise = errors_px(floor(ZED2, 1.0), (DisparityNoise(),), z=1.0)[0]
    for axis in (0, 1):
        for lag in (1, 3, 5, 7, 10):
            expected = max(0.0, 1.0 - lag / 7.0)
            assert correlation(noise, lag, axis) == pytest.approx(expected, abs=0.03)
    # 7 px of 1280 are 1.75 of 320: a pixel and 3/8 of either neighbour.
    noise = errors_px(floor(ZED, 1.0), (DisparityNoise(),), frames=3, z=1.0)
    weights = np.array([0.375, 1.0, 0.375])
    shared = np.convolve(weights, weights)[2:] / np.sum(weights**2)
    for lag in (1, 2, 3):
        expected = shared[lag] if lag < 3 else 0.0
        assert correlation(noise, lag, axis=2) == pytest.approx(expected, abs=0.02)
    # Below a pixel it is white.
    noise = errors_px(floor(SP, 2.0), (DisparityNoise(),), frames=3, z=2.0)
    assert correlation(noise, 1, axis=1) == pytest.approx(0.0, abs=0.01)
    for edge in (noise[:, 0], noise[:, -1], noise[:, :, 0]):
        assert edge.std() == pytest.approx(noise.std(), rel=0.1)


def test_a_stereo_camera_counts_in_steps_and_structured_light_does_not() -> None:
    exact = np.linspace(0.5, 4.0, 180 * 320).reshape(180, 320)
    depth = measure(exact, floor(ZED, 1.0), 1, 0, (DisparitySteps(),))
    step = 0.0625 / 4
    counts = ZED.disparity_at_1m / depth / step
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
    error = ZED.disparity_at_1m * (1.0 / depth - 1.0 / exact)
    assert np.abs(error).max() <= 0.5 * step + 1e-9
    assert error.std() == pytest.approx(step / np.sqrt(12.0), rel=0.02)
    exact = np.full((240, 320), 2.0)
    assert measure(exact, floor(SP, 1.0), 1, 0, (DisparitySteps(),)) is exact


@pytest.mark.parametrize("sensor", [SP, ZED], ids=lambda s: s.model)
@pytest.mark.parametrize("degrees", [0.0, 45.0, 70.0, 80.0])
def test_noise_grows_with_incidence(sensor: DepthSensor, degrees: float) -> None:
    t = np.radians(degrees)
    shot = floor(narrow(sensor, 0.5), 2.0, tilt=(t, 0.0))
    plain = errors_px(shot, (DisparityNoise(),), frames=3).std()
    both = errors_px(shot, (DisparityNoise(), Grazing()), frames=3)
    factor = 1.0 + 0.05 * t**2 / (0.5 * np.pi - t) ** 2
    assert both.std() / plain == pytest.approx(factor, rel=0.03)
    assert abs(both.mean()) < 6 * both.std() / np.sqrt(both.size / max(1.0, sensor.window**2))


@pytest.mark.parametrize("sensor", [SP1000, ZED2], ids=lambda s: s.model)
def test_the_fixed_pattern_is_fixed_smooth_and_without_what_calibration_removes(
    sensor: DepthSensor,
) -> None:
    shot = floor(sensor, 2.0)
    field = errors_px(shot, (FixedPattern(),), frames=2, z=2.0)
    np.testing.assert_array_equal(field[0], field[1])
    other = errors_px(shot, (FixedPattern(),), seed=2, z=2.0)[0]
    assert abs(np.corrcoef(field[0].ravel(), other.ravel())[0, 1]) < 0.6
    rms = np.sqrt(np.mean(field[0] ** 2))
    assert rms == pytest.approx(sensor.pattern, rel=1e-3)
    v, u = np.indices(field[0].shape)
    for part in (np.ones_like(u), u - u.mean(), v - v.mean()):
        assert abs(np.mean(field[0] * part)) < 1e-4 * rms * np.sqrt(np.mean(part**2))
    assert correlation(field[:1], sensor.width // 40, axis=2) > 0.9
    small = floor(sensor.resized(sensor.width // 4, sensor.height // 4), 2.0)
    coarse = 4.0 * errors_px(small, (FixedPattern(),), z=2.0)[0]
    np.testing.assert_allclose(coarse, field[0][2::4, 2::4], atol=0.2 * rms)


def test_the_pattern_of_the_metrology_sensor_is_small() -> None:
    shot = floor(SP, 2.0)
    exact = np.full((240, 320), 3.0)
    error = measure(exact, shot, 1, 0, (FixedPattern(),)) - exact
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.03e-3, rel=0.02)
