"""Waves over the image: what the fixed pattern of a camera is a sum of.

A fixed pattern is an error of the range that is the same in every frame (Teichman, Miller & Thrun
2013): what calibration leaves of lens distortion, rectification and projector. It is taken for a
sum of cosine waves over the image as fine as the blocks over which residuals are taken to be
correlated, and to grow with the range as the sensor's stated noise does. A constant and a slope
over the image are left out: they are a part of where the camera says that it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba.camera import RangeNoise
from depthba.dataset import Sensor

Array = NDArray[np.float64]

# Half waves across or down, up to these.
FINEST = (8, 6)
# What is left of a wave without constant and slope, root mean square, that still makes it one.
LEAST = 0.2


@dataclass(frozen=True)
class Waves:
    """The waves of a camera, as functions of the viewing ray."""

    scale: Array
    """(2,), of x/z and y/z: so many images to a unit."""
    offset: Array
    """(2,), where in the image, 0 to 1, the optical axis lies."""
    orders: NDArray[np.int_]
    """(2, m), half waves across and down."""
    plain: Array
    """(3, m), constant and slopes that are taken off each cosine."""
    rms: Array
    """(m,), of what is left of each cosine, over the image."""
    noise: RangeNoise | None
    typical: float
    """Standard deviation of the range, m, where a wave has its nominal size."""

    def __len__(self) -> int:
        return len(self.rms)

    def at(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return (n, m), m: by how much a unit of each wave moves points (n, 3) along their rays.

        At a point of typical noise; farther and noisier points are moved by more.
        """
        p = points.astype(float)
        u, v = (p[:, :2] / p[:, 2:] * self.scale + self.offset).T
        out = self.over_image(u, v)
        if self.noise is not None:
            out *= (self.noise.of_points(p) / self.typical)[:, None]
        return np.asarray(out, np.float32)

    def over_image(self, u: Array, v: Array) -> Array:
        """Return (n, m) at places in the image (n,), 0 to 1; root mean square 1 over the image."""
        return (_cosines(u, v, self.orders) - _plain(u, v) @ self.plain) / self.rms

    def size(self, pattern: Array) -> float:
        """Return the root mean square over the image of a pattern (m,), in its unit."""
        return float(np.sqrt(np.mean((self.over_image(*_small_image()) @ pattern) ** 2)))


def waves_of(sensor: Sensor, typical: float) -> Waves | None:
    """Return the waves of a sensor with ``typical`` noise, m; None where its rays are not known."""
    camera = sensor.camera
    if camera is None or not sensor.origin:
        return None
    u, v = _small_image()
    orders = np.indices([n + 1 for n in FINEST]).reshape(2, -1)
    orders = orders[:, (orders / np.array(FINEST)[:, None]).sum(axis=0) <= 1]
    raw = _cosines(u, v, orders)
    plain = np.linalg.lstsq(_plain(u, v), raw, rcond=None)[0]
    rms = np.sqrt(np.mean((raw - _plain(u, v) @ plain) ** 2, axis=0))
    kept = rms > LEAST
    size = np.array([camera.width, camera.height])
    return Waves(
        scale=np.array([camera.fx, camera.fy]) / size,
        offset=(np.array([camera.cx, camera.cy]) + 0.5) / size,
        orders=orders[:, kept],
        plain=np.asarray(plain[:, kept], np.float64),
        rms=rms[kept],
        noise=sensor.noise,
        typical=typical,
    )


def _small_image() -> tuple[Array, Array]:
    """Return the pixels' centres (n,) of a small image, 0 to 1: they stand for those of any."""
    grid = [(np.arange(8 * n) + 0.5) / (8 * n) for n in FINEST]
    u, v = np.meshgrid(*grid)
    return u.ravel(), v.ravel()


def _cosines(u: Array, v: Array, orders: NDArray[np.int_]) -> Array:
    across, down = (_multiples(np.cos(np.pi * x), n) for x, n in zip((u, v), FINEST, strict=True))
    return np.asarray((across[orders[0]] * down[orders[1]]).T)


def _multiples(cosine: Array, count: int) -> Array:
    """Return (count + 1, n), the cosines of the multiples of an angle (Chebyshev's recurrence)."""
    out = np.empty((count + 1, len(cosine)))
    out[0], out[1] = 1.0, cosine
    for k in range(2, count + 1):
        out[k] = 2 * cosine * out[k - 1] - out[k - 2]
    return out


def _plain(u: Array, v: Array) -> Array:
    return np.stack([np.ones_like(u), u - 0.5, v - 0.5], axis=1)
