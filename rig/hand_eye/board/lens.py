"""Projection through OpenCV's lens model, with its derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera

Array = NDArray[np.float64]

NAMES = ("focal length", "aspect", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""What can be off about a camera: log of the focal lengths, log of fx over fy, px, px, and the
distortion."""


def changed(camera: Camera, off: Array) -> Camera:
    """Return the camera with its nine numbers off by (9,), as `NAMES` has them."""
    k1, k2, p1, p2, k3 = (float(k + d) for k, d in zip(camera.distortion, off[4:], strict=True))
    return Camera(
        camera.width,
        camera.height,
        float(camera.fx * np.exp(off[0] + off[1] / 2)),
        float(camera.fy * np.exp(off[0] - off[1] / 2)),
        float(camera.cx + off[2]),
        float(camera.cy + off[3]),
        (k1, k2, p1, p2, k3),
    )


def project(points: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """Project points and differentiate.

    Args:
        points: (..., 3), camera frame, m; z <= 0 gives NaN.
        camera: the intrinsics.

    Returns:
        Pixels (..., 2), and their derivatives by the point (..., 2, 3), px per m, and by what
        `changed` takes (..., 2, 9).
    """
    z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    x, y = points[..., 0] / z, points[..., 1] / z
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * r2 * k3)
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    fx, fy = camera.fx, camera.fy
    pixels = np.stack([fx * xd + camera.cx, fy * yd + camera.cy], axis=-1)
    # by the ideal coordinates (x, y), then by the point
    xx = fx * (radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x)
    yy = fy * (radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x)
    xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    by_point = np.empty((*z.shape, 2, 3))
    by_point[..., 0, 0], by_point[..., 0, 1] = xx / z, fx * xy / z
    by_point[..., 1, 0], by_point[..., 1, 1] = fy * xy / z, yy / z
    by_point[..., 2] = -(by_point[..., 0] * x[..., None] + by_point[..., 1] * y[..., None])
    by_lens = np.zeros((*z.shape, 2, 9))
    by_lens[..., 0, 0], by_lens[..., 1, 0] = fx * xd, fy * yd
    by_lens[..., 0, 1], by_lens[..., 1, 1] = fx * xd / 2, -fy * yd / 2
    by_lens[..., 0, 2] = by_lens[..., 1, 3] = 1.0
    for column, power in ((4, r2), (5, r2**2), (8, r2**3)):
        by_lens[..., 0, column], by_lens[..., 1, column] = fx * x * power, fy * y * power
    by_lens[..., 0, 6], by_lens[..., 1, 6] = fx * 2 * x * y, fy * (r2 + 2 * y * y)
    by_lens[..., 0, 7], by_lens[..., 1, 7] = fx * (r2 + 2 * x * x), fy * 2 * x * y
    return pixels, by_point, by_lens
