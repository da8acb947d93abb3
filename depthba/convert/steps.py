"""Whether depth comes, and is kept, in steps that are fine enough for what it measures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from depthba.convert.recording import Recording
from depthba.errors import DatasetError

Array = NDArray[np.float64]

FEWEST = 50
"""Steps in a typical depth. A camera of whole mm has as many at 5 cm, nearer than such cameras see;
metres rounded to whole numbers, or metres times 0.001 in steps of 0.1 mm, have a few."""
FRAMES, PIXELS = 6, 20_000
"""That are looked at, and of each, at most."""


def refuse_whole_numbers(recording: Recording) -> None:
    """Refuse depth that was rounded to a few whole numbers before it came here.

    Raises `DatasetError`, which says what the images hold.
    """
    unit = recording.depth_scale
    if unit is None:
        return
    values = _depths(recording) / unit
    whole = np.rint(values)
    if not len(values) or np.median(values) >= FEWEST or np.abs(values - whole).max() > 1e-6:
        return
    few = np.unique(whole)
    held = f"only the value {few[0]:g}" if len(few) == 1 else f"whole numbers, {_range(whole)}"
    raise DatasetError(
        f"{recording.path}: depth images hold {held}: were metres rounded to whole numbers? "
        "expected millimetres or a finer step, or --unchecked"
    )


def refuse_coarse(recording: Recording, step: float) -> None:
    """Refuse to keep depth in steps, m, that leave little of it. `DatasetError` says how little."""
    depths = _depths(recording)
    if len(depths) and (typical := float(np.median(depths))) < FEWEST * step:
        raise DatasetError(
            f"{recording.path}: depth of typically {typical:.3g} m would be kept in steps of "
            f"{step:g} m, expected {FEWEST} steps or more: is --depth-scale right? or --unchecked"
        )


def _range(values: Array) -> str:
    return f"{values.min():g} to {values.max():g}, half of them up to {np.median(values):g}"


def _depths(recording: Recording) -> Array:
    """Return some of the depths (n,), m, of frames that are spread over the recording."""
    found = [np.empty(0)]
    for k in sorted({round(k) for k in np.linspace(0, len(recording.frames) - 1, FRAMES)}):
        if (depth := recording.frames[k].depth) is not None:
            z = depth()
            z = z[np.isfinite(z) & (z > 0)]
            found.append(z[:: max(1, len(z) // PIXELS)])
    return np.concatenate(found)
