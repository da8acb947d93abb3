from __future__ import annotations

import numpy as np
import pytest

from depthba import se3
from depthba.errors import OptionError
from sim.rigs.gantry import Gantry


def test_start_errors_are_gaussian_per_axis_with_frame_0_exact() -> None:
    track = Gantry().track(None, seed=5, frames=2000, start_error=(0.03, 0.02))
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
            Gantry().track(None, seed=0, start_error=wrong)
    with pytest.raises(OptionError, match="frames 0"):
        Gantry().track(None, seed=0, frames=0)


def test_the_gantry_believes_what_it_reports() -> None:
    """Over many captures the errors are as large as pose_noise says, axis by axis."""
    scores = []
    for seed in range(150):
        track = Gantry().track(None, seed)
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
    one, two, none = (Gantry().track(None, 4, scale=s) for s in (1.0, 2.0, 0.0))
    np.testing.assert_array_equal(none.T_world_camera, none.T_world_camera_true)
    assert none.sigma_t is None
    moved = [se3.difference(t.T_world_camera, t.T_world_camera_true)[:, :3] for t in (one, two)]
    np.testing.assert_allclose(2 * moved[0], moved[1], atol=5e-4)
