"""The floor of the industrial bay: fines raked roughly level, and heaps at the angle of repose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from sim.engine import mujoco
from sim.scenes.relief import Relief
from sim.scenes.stones import Keep

Array = NDArray[np.float64]


def make_ground(
    rng: np.random.Generator,
    area: tuple[float, float, float, float],
    spacing: float,
    level: tuple[Keep, ...],
    heaps: int = 10,
    repose: float = np.radians(34.0),
) -> Relief:
    """The bare floor over `area` (xmin, xmax, ymin, ymax) m; z = 0 on the discs of `level`."""
    columns = round((area[1] - area[0]) / spacing) + 1
    rows = round((area[3] - area[2]) / spacing) + 1
    x = np.asarray(area[0] + spacing * np.arange(columns), np.float64)[None, :]
    y = np.asarray(area[2] + spacing * np.arange(rows), np.float64)[:, None]
    # Undulation as left by a wheel loader: long swells and shorter ones, a few wavelengths only.
    z = _swell(rng, (rows, columns), 0.90 / spacing, 0.045)
    z += _swell(rng, (rows, columns), 0.22 / spacing, 0.034)
    z += _swell(rng, (rows, columns), 0.09 / spacing, 0.010)
    for _ in range(heaps):
        z = np.maximum(z, _heap(rng, area, x, y, repose))
    z = gaussian_filter(z, 0.035 / spacing)
    for disc in level:
        away = np.hypot(x - disc.x, y - disc.y)
        z *= np.clip((away - disc.radius) / 0.5, 0.0, 1.0) ** 2 * (
            3.0 - 2.0 * np.clip((away - disc.radius) / 0.5, 0.0, 1.0)
        )
    return Relief(np.clip(z, -0.10, None), (area[0], area[2]), spacing)


def add_ground(spec: mujoco.MjSpec, relief: Relief, colour: tuple[float, float, float]) -> None:
    """Put a relief into the model as the height field `ground`."""
    rows, columns = relief.z.shape
    low, high = float(relief.z.min()), float(relief.z.max())
    half = (0.5 * relief.spacing * (columns - 1), 0.5 * relief.spacing * (rows - 1))
    spec.add_hfield(
        name="ground",
        nrow=rows,
        ncol=columns,
        size=[*half, high - low, 0.1],
        userdata=((relief.z - low) / (high - low)).astype(np.float32).ravel(),
    )
    spec.worldbody.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="ground",
        pos=[relief.origin[0] + half[0], relief.origin[1] + half[1], low],
        rgba=[*colour, 1.0],
    )


def _swell(
    rng: np.random.Generator, shape: tuple[int, int], sigma: float, amplitude: float
) -> Array:
    field = gaussian_filter(rng.normal(size=shape), sigma, mode="reflect")
    return np.asarray(field * (amplitude / field.std()), float)


def _heap(
    rng: np.random.Generator,
    area: tuple[float, float, float, float],
    x: Array,
    y: Array,
    repose: float,
) -> Array:
    """A tipped load: a ridge with slopes just under the angle of repose."""
    cx, cy = rng.uniform(area[0], area[1]), rng.uniform(area[2], area[3])
    heading, length = rng.uniform(0.0, np.pi), rng.uniform(0.1, 0.7)
    height, steep = rng.uniform(0.11, 0.24), np.tan(repose) * rng.uniform(0.6, 0.95)
    along = (x - cx) * np.cos(heading) + (y - cy) * np.sin(heading)
    across = -(x - cx) * np.sin(heading) + (y - cy) * np.cos(heading)
    outside = np.maximum(np.abs(along) - 0.5 * length, 0.0)
    return height - steep * np.hypot(outside, across)
