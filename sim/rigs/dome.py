"""Camera poses on a dome over the work area of the lab's table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Dome:
    """Gaze points spread over an area of the plane z = `gaze`, each seen from above.

    The stations lie in rows along x, every other one back; the image's x axis is along world x
    but for the roll.
    """

    x: tuple[float, float] = (-0.48, 0.48)
    y: tuple[float, float] = (0.33, 0.74)
    """Where the gaze points lie, m; the view reaches further."""
    gaze: float = 0.05
    """Height of the gaze points, m."""
    distance: tuple[float, float] = (0.45, 0.75)
    """From the gaze point to the camera, m."""
    tilt: float = float(np.radians(35.0))
    """The most by which the camera looks away from straight down, rad."""
    roll: float = float(np.radians(20.0))
    """The most by which the image turns about its own axis, rad."""
    alternatives: int = 40
    """Poses to choose from at each station."""

    def __call__(self, rng: np.random.Generator, count: int) -> Iterator[Array]:
        """Stacks (alternatives, 4, 4) of T_world_camera, one for each of `count` stations.

        Then twice as many again at random places, in case some stations cannot be had.
        """
        for x, y in self.stations(rng, count):
            yield self._around(rng, x, y)
        for _ in range(2 * count):
            yield self._around(rng, rng.uniform(*self.x), rng.uniform(*self.y))

    def stations(self, rng: np.random.Generator, count: int) -> Array:
        """Gaze points (count, 2) in order, m."""
        width, depth = self.x[1] - self.x[0], self.y[1] - self.y[0]
        rows = max(1, round(np.sqrt(count * depth / width)))
        lengths = [count // rows + (k < count % rows) for k in range(rows)]
        places = []
        for row, (y, n) in enumerate(zip(_cells(*self.y, rows), lengths, strict=True)):
            xs = _cells(*self.x, n)
            places += [(x, y) for x in (xs if row % 2 == 0 else xs[::-1])]
        cell = np.array([width / max(lengths), depth / rows])
        moved = np.array(places) + cell * rng.uniform(-0.2, 0.2, (count, 2))
        return np.clip(moved, [self.x[0], self.y[0]], [self.x[1], self.y[1]])

    def _around(self, rng: np.random.Generator, x: float, y: float) -> Array:
        n = self.alternatives
        # Even over the cap that the tilt leaves.
        tilt = np.arccos(1.0 - rng.uniform(0.0, 1.0, n) * (1.0 - np.cos(self.tilt)))
        towards = rng.uniform(-np.pi, np.pi, n)
        lean = tilt[:, None] * np.stack([np.cos(towards), np.sin(towards), 0.0 * tilt], axis=-1)
        spin = np.zeros((n, 3))
        spin[:, 2] = rng.uniform(-self.roll, self.roll, n)
        R = se3.exp_so3(lean) @ np.diag([1.0, -1.0, -1.0]) @ se3.exp_so3(spin)
        away = rng.uniform(*self.distance, n)[:, None] * R[:, :, 2]
        return se3.make(R, np.array([x, y, self.gaze]) - away)


def _cells(low: float, high: float, count: int) -> Array:
    """The middles of `count` equal parts, spread so that the outer ones lie at the ends."""
    return np.linspace(low, high, count) if count > 1 else np.array([0.5 * (low + high)])
