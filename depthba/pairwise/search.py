"""How one frame lies on another, searched within what the start poses may be off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.pairwise import correlate
from depthba.pairwise.raster import Lattice, Raster, rasterise, relief

Floats = NDArray[np.float64]

# The search ends this many standard deviations from the start.
REACH = 4.0
# Turns of the search, in cells by which they move the end of a half side.
TURN = 3.0


@dataclass(frozen=True)
class View:
    """A frame as it stands in the map."""

    points: Floats
    """(n, 3) about ``centre``, axes of the map, m."""
    centre: Floats
    """(3,), where the middle of the points lies in the map, m."""
    raster: Raster
    relief: NDArray[np.float32]


@dataclass(frozen=True)
class Doubt:
    """What a frame's start pose may be off."""

    centre: Floats
    """(2, 2), covariance of where the centre lies in x and y, m^2."""
    turn: float
    """Variance of the turn about the map's normal, rad^2."""


@dataclass(frozen=True)
class Candidate:
    """A way to lay frame j onto frame i."""

    i: int
    j: int
    T_map_map: Floats
    """(4, 4): moves frame j from where it stands to where it lies on frame i."""
    r: float
    """Correlation of the reliefs."""
    evidence: float


def view_of(points: Floats, lattice: Lattice) -> View:
    """Put a frame's points (n, 3), given in the map, on the raster."""
    centre = middle(points)
    raster = rasterise(points - centre, lattice)
    return View(points - centre, centre, raster, relief(raster))


def middle(points: Floats) -> Floats:
    """Return the middle (3,) of the points' range in x and y, and their median height."""
    if not len(points):
        return np.zeros(3)
    low, high = np.quantile(points[:, :2], [0.01, 0.99], axis=0)
    return np.append((low + high) / 2, np.median(points[:, 2]))


def shared(a: View, b: View, lattice: Lattice) -> float:
    """Return the share of the smaller frame's cells that the other sees too."""
    side = lattice.side
    dx, dy = np.rint((b.centre - a.centre)[:2] / lattice.cell).astype(int)
    fewer = min(int(a.raster.seen.sum()), int(b.raster.seen.sum()))
    if abs(dx) >= side or abs(dy) >= side or not fewer:
        return 0.0
    first = a.raster.seen[max(dy, 0) : side + min(dy, 0), max(dx, 0) : side + min(dx, 0)]
    second = b.raster.seen[max(-dy, 0) : side + min(-dy, 0), max(-dx, 0) : side + min(-dx, 0)]
    return float((first & second).sum()) / fewer


def search(
    views: list[View],
    spectra: list[correlate.Spectrum],
    doubts: list[Doubt],
    j: int,
    partners: list[int],
    lattice: Lattice,
) -> list[Candidate | None]:
    """Search how frame j lies on each of its partners.

    Each turn of frame j is put on the raster once and correlated with all partners.
    """
    moving, size = views[j], correlate.padded(lattice)
    expected = [
        _Expected.of(moving.centre - views[i].centre, doubts[i], doubts[j], lattice)
        for i in partners
    ]
    best: list[tuple[correlate.Shift, float] | None] = [None for _ in partners]
    step = TURN / lattice.side
    widest = REACH * max((e.turn for e in expected), default=0.0)
    steps = int(np.ceil(min(widest, np.pi) / step))
    for angle in step * np.arange(-steps, steps + 1):
        turned = rasterise(moving.points @ se3.exp_so3([0.0, 0.0, angle]).T, lattice)
        spectrum = correlate.spectrum(relief(turned), turned.seen, size)
        for k, (i, start) in enumerate(zip(partners, expected, strict=True)):
            if abs(angle) > REACH * start.turn + step:
                continue
            r, count = correlate.correlation(spectra[i], spectrum, size, start.window)
            score = correlate.evidence(r, count) - start.cost - 0.5 * (angle / start.turn) ** 2
            peak, so_far = correlate.peak(score, r, start.window, lattice.cell), best[k]
            if peak and (so_far is None or peak.evidence > so_far[0].evidence):
                best[k] = peak, float(angle)
    return [
        _candidate(views, i, j, *found, lattice) if found else None
        for i, found in zip(partners, best, strict=True)
    ]


@dataclass(frozen=True)
class _Expected:
    """Where the start poses have one frame on another, and how surely."""

    window: correlate.Window
    cost: NDArray[np.float32]
    """(h, w), minus the log likelihood of each shift; infinite out of reach."""
    turn: float
    """Standard deviation of the turn, rad."""

    @classmethod
    def of(cls, apart: Floats, fixed: Doubt, moving: Doubt, lattice: Lattice) -> _Expected:
        middle, covariance = apart[:2], fixed.centre + moving.centre
        reach = REACH * np.sqrt(np.diag(covariance))
        most = lattice.side - 1
        low = np.clip(np.floor((middle - reach) / lattice.cell).astype(int), -most, most)
        high = np.clip(np.ceil((middle + reach) / lattice.cell).astype(int), -most, most)
        columns, rows = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
        dx = columns[None, :] * lattice.cell - middle[0]
        dy = rows[:, None] * lattice.cell - middle[1]
        (xx, xy), (_, yy) = np.linalg.inv(covariance)
        far = xx * dx**2 + 2 * xy * dx * dy + yy * dy**2
        cost = np.where(far <= REACH**2, 0.5 * far, np.inf).astype(np.float32)
        return cls(correlate.Window(rows, columns), cost, float(np.sqrt(fixed.turn + moving.turn)))


def _candidate(
    views: list[View], i: int, j: int, shift: correlate.Shift, angle: float, lattice: Lattice
) -> Candidate:
    """Add height, roll and pitch, by a plane through the difference of the heights."""
    R = se3.exp_so3([0.0, 0.0, angle])
    moved = rasterise(views[j].points @ R.T + np.append(shift.xy, 0.0), lattice)
    fixed = views[i].raster
    both = fixed.seen & moved.seen
    y, x = np.nonzero(both)
    xy = np.asarray((np.stack([x, y], axis=1) - lattice.side // 2) * lattice.cell, float)
    apart = fixed.heights[both].astype(float) - moved.heights[both].astype(float)
    height, along_x, along_y = _plane(xy, apart)
    # about the centre of frame i, which lies at the height of its surface
    tilt = se3.exp_so3([along_y, -along_x, 0.0])
    T_i_j = se3.make(tilt @ R, tilt @ np.append(shift.xy, 0.0) + [0.0, 0.0, height])
    T = _at(views[i].centre) @ T_i_j @ _at(-views[j].centre)
    return Candidate(i, j, T, shift.r, shift.evidence)


def _at(t: Floats) -> Floats:
    return se3.make(np.eye(3), t)


def _plane(xy: Floats, z: Floats) -> tuple[float, float, float]:
    """Fit ``z = a + b x + c y``, robustly (Tukey)."""
    A = np.column_stack([np.ones(len(xy)), xy])
    weight: Floats = np.ones(len(z))
    found: Floats = np.zeros(3)
    for _ in range(8):
        W = A * weight[:, None]
        found = np.asarray(np.linalg.solve(A.T @ W + 1e-9 * np.eye(3), W.T @ z))
        residual = z - A @ found
        scale = 4.685 * max(1.4826 * float(np.median(np.abs(residual))), 1e-9)
        weight = np.asarray(np.square(np.maximum(1 - (residual / scale) ** 2, 0.0)))
    return float(found[0]), float(found[1]), float(found[2])
