from __future__ import annotations

import numpy as np
import pytest

from depthba import se3
from depthba.errors import OptionError
from sim.errors import SimulationError
from sim.noise import STAGES, Shot, choose_stages, measure
from sim.rigs import Gantry
from sim.sensors import SP1000, find_sensor

SENSOR = SP1000.resized(320, 240)
SHOT = Shot(SENSOR, SENSOR.camera.rays())


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


def test_start_errors_are_gaussian_per_axis_with_frame_0_exact() -> None:
    track = Gantry().track(seed=5, frames=2000, start_error=(0.03, 0.02))
    delta = se3.difference(track.T_world_camera, track.T_world_camera_true)
    assert np.array_equal(track.T_world_camera[0], track.T_world_camera_true[0])
    spread = delta[1:].std(axis=0)
    np.testing.assert_allclose(spread, np.repeat([0.03, 0.02], 3), rtol=0.06)
    np.testing.assert_allclose(delta[1:].mean(axis=0), 0.0, atol=0.003)
    assert np.abs(np.corrcoef(delta[1:].T) - np.eye(6)).max() < 0.1
    assert track.sigma_t == (0.03,) * 3 and track.sigma_r == (0.02,) * 3


def test_a_start_error_must_make_sense() -> None:
    for wrong in ((-0.1, 0.0), (0.0, float("nan"))):
        with pytest.raises(OptionError, match="start-error"):
            Gantry().track(seed=0, start_error=wrong)
    with pytest.raises(OptionError, match="frames 0"):
        Gantry().track(seed=0, frames=0)


def test_the_gantry_believes_what_it_reports() -> None:
    """Over many captures the errors are as large as pose_noise says, axis by axis."""
    scores = []
    for seed in range(150):
        track = Gantry().track(seed)
        assert track.T_base_flange is not None and track.T_flange_camera is not None
        np.testing.assert_allclose(
            track.T_base_flange @ track.T_flange_camera, track.T_world_camera, atol=1e-12
        )
        delta = se3.difference(track.T_world_camera, track.T_world_camera_true)
        assert track.sigma_t is not None and track.sigma_r is not None
        scores.append(delta / np.array([*track.sigma_t, *track.sigma_r]))
        # Orientation is wrong by the same amount everywhere: nothing turns on a gantry.
        assert np.ptp(delta[:, 3:], axis=0).max() < 1e-12
    rms = np.sqrt(np.mean(np.square(scores), axis=(0, 1)))
    assert ((rms > 0.75) & (rms < 1.25)).all(), rms


def test_pose_noise_scales_and_vanishes() -> None:
    one, two, none = (Gantry().track(4, scale=s) for s in (1.0, 2.0, 0.0))
    np.testing.assert_array_equal(none.T_world_camera, none.T_world_camera_true)
    assert none.sigma_t is None
    moved = [se3.difference(t.T_world_camera, t.T_world_camera_true)[:, :3] for t in (one, two)]
    np.testing.assert_allclose(2 * moved[0], moved[1], atol=5e-4)
