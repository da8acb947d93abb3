"""Where one frame's relief lies on another's: every shift by FFT, turn by turn.

Masked normalised cross-correlation (Padfield, "Masked object registration in the Fourier domain",
2012), for reliefs that already have no mean. A shift is judged by the logarithm of its likelihood
against that of two unrelated surfaces: with correlation r over n independent places that is
``-n/2 log(1 - r^2)``, which weighs a good match of little ground against a fair match of much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from depthba.pairwise.raster import Lattice

# Neighbouring cells are not independent: this many count as one.
ALIKE = 16.0
# Cells two frames must share to be compared.
FEWEST = 150


@dataclass(frozen=True)
class Spectrum:
    """What of a relief enters the correlation, in the Fourier domain."""

    relief: NDArray[np.complex64]
    square: NDArray[np.complex64]
    seen: NDArray[np.complex64]


@dataclass(frozen=True)
class Window:
    """The shifts that are looked at, in cells."""

    rows: NDArray[np.int64]
    """(h,), along y."""
    columns: NDArray[np.int64]
    """(w,), along x."""


@dataclass(frozen=True)
class Shift:
    """One peak: the moving relief lies on the fixed one when moved by ``xy``."""

    xy: NDArray[np.float64]
    """(2,) m, between the frames' centres."""
    r: float
    """Correlation there."""
    evidence: float
    """Logarithm of the likelihood ratio, the start poses' own likelihood included."""


def spectrum(relief: NDArray[np.float32], seen: NDArray[np.bool_], size: int) -> Spectrum:
    """Transform a relief (side, side), padded to ``size``."""
    scale = np.float32(max(np.sqrt(np.mean(np.square(relief[seen]))) if seen.any() else 0.0, 1e-9))
    scaled = relief / scale
    return Spectrum(*(
        fft.rfft2(a.astype(np.float32), (size, size)) for a in (scaled, scaled * scaled, seen)
    ))  # fmt: skip


def padded(lattice: Lattice) -> int:
    """Return the size at which shifts of a whole side do not wrap round."""
    return int(fft.next_fast_len(2 * lattice.side - 1, real=True))


def correlation(
    fixed: Spectrum, moving: Spectrum, size: int, window: Window
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return r and the cells shared, for every shift (rows y, columns x) of a window."""
    stack = np.stack([
        fixed.relief * moving.relief.conj(),
        fixed.square * moving.seen.conj(),
        fixed.seen * moving.square.conj(),
        fixed.seen * moving.seen.conj(),
    ])  # fmt: skip
    every = fft.irfft2(stack, (size, size))
    cross, left, right, shared = every[:, window.rows[:, None] % size, window.columns % size]
    energy = np.maximum(left, 0) * np.maximum(right, 0)
    r = cross / np.sqrt(np.maximum(energy, 1e-3))
    return np.where(shared > FEWEST, np.clip(r, 0.0, 0.999), 0.0), shared


def evidence(r: NDArray[np.float32], shared: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the logarithm of the likelihood ratio of two reliefs being one."""
    return np.asarray(-0.5 * shared / ALIKE * np.log1p(-np.square(r)), np.float32)


def peak(
    score: NDArray[np.float32], r: NDArray[np.float32], window: Window, cell: float
) -> Shift | None:
    """Return the best shift of a window, to a part of a cell; None where no score is above 0."""
    score = np.pad(score, 1, constant_values=-np.inf)
    y, x = np.unravel_index(int(np.argmax(score)), score.shape)
    value = float(score[y, x])
    if not value > 0:
        return None
    fine = np.array([
        _vertex(score[y, x - 1], value, score[y, x + 1]),
        _vertex(score[y - 1, x], value, score[y + 1, x]),
    ])  # fmt: skip
    cells = np.array([window.columns[x - 1], window.rows[y - 1]])
    return Shift((cells + fine) * cell, float(r[y - 1, x - 1]), value)


def _vertex(before: float, middle: float, after: float) -> float:
    """Return where the parabola through three neighbours peaks, in cells."""
    bend = before - 2 * middle + after
    if not (np.isfinite(bend) and bend < 0):
        return 0.0
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))


def compare(
    fixed: NDArray[np.float32],
    fixed_seen: NDArray[np.bool_],
    moved: NDArray[np.float32],
    moved_seen: NDArray[np.bool_],
) -> tuple[float, float]:
    """Return correlation and evidence of two reliefs (side, side) as they lie."""
    both = fixed_seen & moved_seen
    count = int(both.sum())
    if count <= FEWEST:
        return 0.0, 0.0
    a, b = fixed[both].astype(float), moved[both].astype(float)
    r = float(np.clip(a @ b / np.sqrt(max((a @ a) * (b @ b), 1e-30)), 0.0, 0.999))
    return r, float(-0.5 * count / ALIKE * np.log1p(-r * r))
