"""Camera poses on a dome over the work area of the lab's table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TableDome:
    """Gaze points spread over an area of the plane z = `gaze`, each seen from above.

    The stations lie in columns along y, every other one back; the image's x axis is along world x
    but for the roll.
    """

    x: tuple[float, float] = (-0.48, 0.48)
    y: tuple[float, float] = (0.43, 0.74)
    """Where the gaze points lie, m. The view reaches further; nearer ones show the arm's base."""
    gaze: float = 0.05
    """Height of the gaze points, m."""
    distance: tuple[float, float] = (0.45, 0.75)
    """From the gaze point to the camera, m."""
    tilt: float = float(np.radians(35.0))
    """The most by which the camera looks away from straight down, rad."""
    roll: float = float(np.radians(20.0))
    """The most by which the image turns about its own axis, rad."""
    alternatives: int = 100
    """Poses to choose from at each station."""

    def __call__(self, rng: np.random.Generator, count: int) -> Iterator[Array]:
        """Stacks (alternatives, 4, 4) of T_world_camera, one for each of `count` stations.

        Then four times as many at random places, in case some stations cannot be had.
        """
        for x, y in self.stations(rng, count):
            yield self._around(rng, x, y)
        for _ in range(4 * count):
            yield self._around(rng, rng.uniform(*self.x), rng.uniform(*self.y))

    def stations(self, rng: np.random.Generator, count: int) -> Array:
        """Gaze points (count, 2) in order, m."""
        width, depth = self.x[1] - self.x[0], self.y[1] - self.y[0]
        # The view is wider than it is high, by tan 50 over tan 34 degrees: so are the cells.
        columns = min(count, max(1, round(np.sqrt(count * width / depth / 1.77))))
        lengths = [count // columns + (k < count % columns) for k in range(columns)]
        places = []
        for column, (x, n) in enumerate(zip(_spread(*self.x, columns), lengths, strict=True)):
            ys = _spread(*self.y, n)
            places += [(x, y) for y in (ys if column % 2 == 0 else ys[::-1])]
        cell = np.array([width / columns, depth / max(lengths)])
        moved = np.array(places) + cell * rng.uniform(-0.2, 0.2, (count, 2))
        return np.clip(moved, [self.x[0], self.y[0]], [self.x[1], self.y[1]])

    def _around(self, rng: np.random.Generator, x: float, y: float) -> Array:
        n = self.alternatives
        tilt = rng.uniform(0.0, self.tilt, n)
        towards = rng.uniform(-np.pi, np.pi, n)
        lean = tilt[:, None] * np.stack([np.cos(towards), np.sin(towards), 0.0 * tilt], axis=-1)
        spin = np.zeros((n, 3))
        spin[:, 2] = rng.uniform(-self.roll, self.roll, n)
        R = se3.exp_so3(lean) @ np.diag([1.0, -1.0, -1.0]) @ se3.exp_so3(spin)
        away = rng.uniform(*self.distance, n)[:, None] * R[:, :, 2]
        return se3.make(R, np.array([x, y, self.gaze]) - away)


def _spread(low: float, high: float, count: int) -> Array:
    """Evenly spaced numbers from end to end; one alone lies in the middle."""
    return np.linspace(low, high, count) if count > 1 else np.array([0.5 * (low + high)])
