"""What changed between two maps of one place: the difference of their heights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.depth_map import DepthMap
from depthba.errors import OptionError, RunError

Floats = NDArray[np.float64]

ROUNDS = 25
"""Newton steps along the new map's z axis to the old surface; they settle in a few."""
TILTED = 0.5
"""Least cosine between the two maps' z axes."""
FITS = 10
"""Rounds of the robust fit of what both maps differ by as wholes."""
SIGMAS = 5.0
"""A difference counts as a change above this many robust standard deviations."""
FEWEST = 50
"""Nodes that both maps must have seen."""


@dataclass(frozen=True)
class HeightChange:
    """How the heights of a new map differ from an old one's, over the nodes of the new."""

    difference: Floats
    """(ny, nx), new less old, m along the new map's z; NaN outside the common region."""
    old: Floats
    """(ny, nx), heights of the old surface at the nodes of the new map; NaN where it has none."""
    offset: tuple[float, float, float]
    """What was taken off as a motion of the whole: height at the middle of the common region, m,
    and its slopes along x and y. Zero where nothing was."""
    sigma: float
    """Robust standard deviation of the differences, m."""
    least: float
    """From here on a difference counts as a change, m."""
    region: tuple[float, float, float, float]
    """xmin xmax ymin ymax of the common region, map frame of the new map, m."""
    area: float
    """Of the common region, m^2."""
    cell: float
    """Area of a node, m^2."""

    @property
    def changed(self) -> NDArray[np.bool_]:
        """(ny, nx), where the difference counts as a change."""
        return np.asarray(np.abs(np.nan_to_num(self.difference)) > self.least)

    def volume(self, sign: int) -> float:
        """Return the volume that came (sign 1) or went (sign -1), m^3, at least 0."""
        part = np.where(self.changed, sign * np.nan_to_num(self.difference), 0.0)
        return float(np.maximum(part, 0.0).sum()) * self.cell


def height_change(
    new: DepthMap, old: DepthMap, *, as_is: bool = False, least: float | None = None
) -> HeightChange:
    """Compare two maps that share a world frame, in the map frame of the new one.

    From every node of the new map the old surface is sought along the new map's z axis, so that the
    maps may lie in different planes and have different grids. Two captures never share the world
    exactly: what height and tilts they differ by as wholes is fitted robustly (least squares on
    what lies within three robust standard deviations, until that settles) and taken off, which
    takes the larger part of the common region to be unchanged. A shift in the plane is left in.

    Args:
        new: the map after.
        old: the map before.
        as_is: leave the motion of the whole in.
        least: difference that counts as a change, m; None: five robust standard deviations.

    Raises:
        OptionError: ``least`` is not above 0.
        RunError: the maps have too little in common.

    """
    if least is not None and not least > 0:
        raise OptionError(f"--least {least:g}: expected a number above 0")
    below = _heights_of(old, new)
    difference = new.heights - below
    common = np.isfinite(difference)
    if common.sum() < FEWEST:
        raise RunError(
            f"change: the maps have {common.sum()} nodes in common, expected at least {FEWEST}: "
            "are both runs in one world frame?"
        )
    rows, columns = np.nonzero(common)
    s = new.spacing
    x, y = new.origin[0] + s * columns, new.origin[1] + s * rows
    region = float(x.min()), float(x.max()), float(y.min()), float(y.max())
    offset = np.zeros(3)
    if not as_is:
        terms = np.stack([np.ones(len(x)), x - x.mean(), y - y.mean()], axis=1)
        offset = _robust_fit(terms, difference[common])
        difference = difference.copy()
        difference[common] -= terms @ offset
    inner = difference[common]
    sigma = 1.4826 * float(np.median(np.abs(inner - np.median(inner))))
    return HeightChange(
        difference,
        below,
        (float(offset[0]), float(offset[1]), float(offset[2])),
        sigma,
        SIGMAS * sigma if least is None else least,
        region,
        float(common.sum()) * s * s,
        s * s,
    )


def _heights_of(old: DepthMap, new: DepthMap) -> Floats:
    """Return (ny, nx) the old surface's heights at the nodes of the new map, in its frame."""
    from scipy.ndimage import map_coordinates

    T = old.T_map_world @ se3.inverse(new.T_map_world)  # T_old_new
    if T[2, 2] < TILTED:
        raise RunError(
            f"change: the maps' z axes are {np.degrees(np.arccos(np.clip(T[2, 2], -1, 1))):.0f}° "
            "apart, expected maps of one side of the scene"
        )
    ny, nx = new.shape
    x, y = np.meshgrid(
        new.origin[0] + new.spacing * np.arange(nx), new.origin[1] + new.spacing * np.arange(ny)
    )
    z = np.nan_to_num(new.heights, nan=float(np.nanmedian(new.heights)))
    gap = np.full(z.shape, np.nan)
    for _ in range(ROUNDS):
        p = np.stack([x, y, z], axis=-1) @ T[:3, :3].T + T[:3, 3]
        at = (np.moveaxis(p[..., 1::-1], -1, 0) - np.array(old.origin[::-1])[:, None, None]) / (
            old.spacing
        )
        gap = p[..., 2] - map_coordinates(old.heights, at, order=1, cval=np.nan)
        z = np.where(np.isfinite(gap), z - gap / T[2, 2], z)
    return np.where(np.abs(gap) < 1e-3 * old.spacing, z, np.nan)


def _robust_fit(terms: Floats, values: Floats) -> Floats:
    """Return coefficients (k,) for ``terms`` (n, k), of what most of the values (n,) follow."""
    found = np.zeros(terms.shape[1])
    found[0] = np.median(values)
    for _ in range(FITS):
        off = values - terms @ found
        near = np.abs(off) <= 3.0 * 1.4826 * np.median(np.abs(off))
        found = np.linalg.lstsq(terms[near], values[near], rcond=None)[0]
    return np.asarray(found)
