"""Noise that is smooth over a matching window."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

Image = NDArray[np.float32]


def taps(width: float) -> Image:
    """A box of a width in pixels, whole or not, at least 1; its squares sum to 1."""
    half = 0.5 * (max(width, 1.0) - 1.0)
    whole = int(half)
    rim = [half - whole] if half > whole else []
    box = np.array([*rim, *np.ones(2 * whole + 1), *rim])
    return (box / np.sqrt(np.sum(box**2))).astype(np.float32)


def windowed(rng: np.random.Generator, shape: tuple[int, ...], width: float) -> Image:
    """Gaussian noise of unit variance, (height, width): white noise seen through a window.

    Draws so many pixels apart are correlated by the share of the window that they have in common,
    along each axis. A window of a pixel or less leaves the noise white.
    """
    box = taps(width)
    r = len(box) // 2
    noise = rng.standard_normal((shape[0] + 2 * r, shape[1] + 2 * r), np.float32)
    if r == 0:
        return noise
    for axis in (0, 1):
        noise = correlate1d(noise, box, axis=axis, mode="constant")
    return np.asarray(noise[r:-r, r:-r])
