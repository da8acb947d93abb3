"""The pinhole camera with OpenCV's distortion, and the noise of a range sensor.

Camera frame: x right, y down, z forward. Pixel centres are at integer coordinates.
Depth is z, not range.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_NEWTON_STEPS = 20


@dataclass(frozen=True)
class Camera:
    """Size and intrinsics of a camera, in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1 k2 p1 p2 k3, as in OpenCV."""

    @property
    def matrix(self) -> Array:
        """The (3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def json(self) -> dict[str, Any]:
        """Return what dataset.json holds of it."""
        sizes = {name: getattr(self, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        return {**sizes, "distortion": list(self.distortion)}

    def rays(self) -> Array:
        """Return the undistorted ray of each pixel, (height, width, 3), z = 1; read-only.

        A pixel that no point can reach (the distortion polynomial folds before it) is NaN.
        """
        return self._rays

    def backproject(self, depth: ArrayLike) -> Array:
        """Return the points (n, 3), metres, of a depth image (height, width) in row order.

        A pixel that is NaN, infinite or not above 0 is no measurement and gives no point.
        """
        z = np.asarray(depth, dtype=np.float64)
        if z.shape != (self.height, self.width):
            raise ValueError(
                f"depth of shape {z.shape},"
                f" expected (height, width) = ({self.height}, {self.width})"
            )
        seen = np.isfinite(z) & (z > 0)
        points = self._rays[seen] * z[seen][:, None]
        if any(self.distortion):
            points = points[np.isfinite(points[:, 0])]
        return np.asarray(points)

    def project(self, p_camera: ArrayLike) -> Array:
        """Return the pixels (n, 2), (u, v), of points (n, 3), metres; NaN where z <= 0."""
        p = np.asarray(p_camera, dtype=np.float64)
        z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        xy = p[..., :2] / z[..., None]
        if any(self.distortion):
            xy = _distort(xy, self.distortion)[0]
        return np.asarray(xy * [self.fx, self.fy] + [self.cx, self.cy])

    @cached_property
    def _rays(self) -> Array:
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        xy = np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy], axis=-1)
        if any(self.distortion):
            xy = _undistort(xy, self.distortion)
        rays = np.concatenate([xy, np.ones((self.height, self.width, 1))], axis=-1)
        rays.setflags(write=False)
        return rays


@dataclass(frozen=True)
class RangeNoise:
    """Standard deviation of a range sensor: ``sigma_m * (z / at_m) ** power``."""

    sigma_m: float
    """Standard deviation at the depth ``at_m``, metres."""
    at_m: float = 1.0
    """Depth for which ``sigma_m`` holds, metres."""
    power: float = 0.0
    """How it grows with depth; 0: constant, 2: stereo."""
    along: Literal["range", "z"] = "range"
    """Whether the error lies along the ray or along z."""

    def sigma(self, z: ArrayLike) -> Array:
        """Return the standard deviation in metres at depths ``z`` in metres, same shape."""
        return np.asarray(
            self.sigma_m * (np.asarray(z, dtype=np.float64) / self.at_m) ** self.power
        )

    def of_points(self, points: ArrayLike) -> Array:
        """Return the standard deviation of the range, metres, at points (n, 3)."""
        p = np.asarray(points, dtype=np.float64)
        sigma = self.sigma(p[:, 2])
        if self.along == "z":  # an error of z moves the point along its ray by that much more
            sigma = sigma * np.linalg.norm(p, axis=1) / np.maximum(p[:, 2], 1e-9)
        return np.asarray(sigma)


def _distort(xy: Array, distortion: tuple[float, ...]) -> tuple[Array, Array]:
    """Return distorted normalised coordinates (..., 2) and their Jacobian (..., 2, 2)."""
    k1, k2, p1, p2, k3 = distortion
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)  # d radial / d r2
    out = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    J = np.empty((*xy.shape, 2))
    J[..., 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    J[..., 0, 1] = J[..., 1, 0] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    J[..., 1, 1] = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return out, J


def _undistort(xy_distorted: Array, distortion: tuple[float, ...]) -> Array:
    """Invert `_distort` by Newton's method; NaN where the centre's branch does not reach."""
    xy = xy_distorted.copy()
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            value, J = _distort(xy, distortion)
            e = xy_distorted - value
            if not np.nanmax(np.abs(e), initial=0.0) > 1e-14:
                break
            det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] ** 2
            xy = xy + np.stack(
                [
                    (J[..., 1, 1] * e[..., 0] - J[..., 0, 1] * e[..., 1]) / det,
                    (J[..., 0, 0] * e[..., 1] - J[..., 0, 1] * e[..., 0]) / det,
                ],
                axis=-1,
            )
        good = np.abs(_distort(xy, distortion)[0] - xy_distorted).max(axis=-1) < 1e-9
        for share in np.linspace(0.125, 1, 8):  # a fold on the way from the centre: another branch
            J = _distort(share * xy, distortion)[1]
            good &= J[..., 0, 0] * J[..., 1, 1] > J[..., 0, 1] ** 2
    return np.asarray(np.where(good[..., None], xy, np.nan))
