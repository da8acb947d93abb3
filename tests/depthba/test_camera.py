"""The camera against OpenCV, and what counts as a measurement."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from depthba.camera import Camera, RangeNoise

PLAIN = Camera(64, 48, 60.0, 61.0, 31.2, 23.9)
BENT = Camera(64, 48, 60.0, 61.0, 31.2, 23.9, (-0.25, 0.08, 0.003, -0.002, -0.01))


@pytest.mark.parametrize("camera", [PLAIN, BENT], ids=["plain", "distorted"])
def test_every_pixel_goes_out_and_comes_back(camera: Camera) -> None:
    depth = np.random.default_rng(0).uniform(0.5, 4, (48, 64))
    points = camera.backproject(depth)
    assert points.shape == (48 * 64, 3)
    np.testing.assert_allclose(points[:, 2], depth.ravel())
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    np.testing.assert_allclose(
        camera.project(points), np.stack([u, v], -1).reshape(-1, 2), atol=1e-9
    )


def test_distortion_is_opencvs() -> None:
    points = np.random.default_rng(1).uniform([-0.5, -0.4, 1], [0.5, 0.4, 3], (200, 3))
    there, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), BENT.matrix, np.array(BENT.distortion)
    )
    np.testing.assert_allclose(BENT.project(points), there[:, 0], atol=1e-9)


def test_formula_of_the_format_page() -> None:
    depth = np.full((48, 64), np.nan)
    depth[10, 40] = 2.0
    np.testing.assert_allclose(
        PLAIN.backproject(depth), [[(40 - 31.2) / 60 * 2, (10 - 23.9) / 61 * 2, 2]]
    )


def test_only_positive_finite_depths_are_measurements() -> None:
    depth = np.zeros((48, 64))
    depth[0, :5] = [np.nan, np.inf, -np.inf, -1.0, 1.0]
    assert PLAIN.backproject(depth).shape == (1, 3)
    assert PLAIN.backproject(np.zeros((48, 64))).shape == (0, 3)
    with pytest.raises(ValueError, match=r"\(64, 48\), expected \(height, width\) = \(48, 64\)"):
        PLAIN.backproject(np.ones((64, 48)))


def test_pixels_that_no_ray_reaches_give_no_points() -> None:
    folding = Camera(64, 48, 20.0, 20.0, 31.5, 23.5, (-0.3, 0.0, 0.0, 0.0, 0.0))
    rays = folding.rays()
    reached = np.asarray(np.isfinite(rays).all(axis=-1))
    assert 0.2 < reached.mean() < 0.9
    assert reached[23, 31] and not reached[0, 0]
    # the radius x(1 - 0.3 x^2) turns round at 1/sqrt(0.9): no ray may lie behind that
    assert np.linalg.norm(rays[reached][:, :2], axis=1).max() < 1 / np.sqrt(0.9)
    points = folding.backproject(np.ones((48, 64)))
    assert len(points) == reached.sum() and np.isfinite(points).all()


def test_rays_are_shared_and_cannot_be_changed() -> None:
    assert PLAIN.rays() is PLAIN.rays()
    with pytest.raises(ValueError, match="read-only"):
        PLAIN.rays()[0, 0, 0] = 1


def test_nothing_behind_the_camera_is_projected() -> None:
    assert np.isnan(PLAIN.project([[0, 0, 0.0], [0.1, 0, -1]])).all()


def test_noise_grows_with_the_power_of_depth() -> None:
    np.testing.assert_allclose(RangeNoise(0.002, 1.0, 2).sigma([1, 2]), [0.002, 0.008])
    np.testing.assert_allclose(RangeNoise(0.003, 2.0).sigma([1, 5]), [0.003, 0.003])
