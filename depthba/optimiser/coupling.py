"""Products with the coupling of poses and map."""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from depthba.compiling import kernel
from depthba.optimiser.linearise import Footprint, Linearisation
from depthba.optimiser.workers import Workers


@kernel
def _spread(values, x0, y0, v, out, first, last):
    """Add ``B^T v`` of one frame to the rows ``first`` to ``last`` of the field ``out``."""
    for y in range(max(first - y0, 0), min(last - y0, values.shape[0])):
        for x in range(values.shape[1]):
            b = values[y, x]
            out[y + y0, x + x0] += (
                b[0] * v[0] + b[1] * v[1] + b[2] * v[2] + b[3] * v[3] + b[4] * v[4] + b[5] * v[5]
            )


@kernel
def _gather(values, x0, y0, field, out):
    """Add ``B field`` of one frame to ``out`` (6,)."""
    for y in range(values.shape[0]):
        for x in range(values.shape[1]):
            f = field[y + y0, x + x0]
            b = values[y, x]
            for m in range(6):
                out[m] += b[m] * f


def spread(
    lin: Linearisation, pose: NDArray[np.float64], workers: Workers | None = None
) -> NDArray[np.float64]:
    """Return ``B^T pose``, (ny, nx), for pose (N, 6)."""
    field = np.zeros_like(lin.g_map)
    spread_over(lin.B, pose, field, workers)
    return field


def spread_over(
    footprints: tuple[Footprint, ...],
    pose: NDArray[np.float64],
    field: NDArray[np.float64],
    workers: Workers | None,
) -> None:
    """Add every frame's values times its part of ``pose`` to the field, band by band of rows."""

    def rows(band: tuple[int, int]) -> None:
        for foot, v in zip(footprints, pose, strict=True):
            if v.any():
                _spread(foot.values, foot.x, foot.y, v, field, *band)

    if workers is None:
        rows((0, len(field)))
    else:
        workers.map(rows, workers.bands(len(field)))


def gather(
    lin: Linearisation, field: NDArray[np.float64], workers: Workers | None = None
) -> NDArray[np.float64]:
    """Return ``B field``, (N, 6)."""
    return gathered(lin.B, field, workers)


def gathered(
    footprints: tuple[Footprint, ...], field: NDArray[np.float64], workers: Workers | None = None
) -> NDArray[np.float64]:
    """Return for each frame the sum over the nodes of its values times the field, (N, 6)."""
    out = np.zeros((len(footprints), 6))

    def one(foot: Footprint, total: NDArray[np.float64]) -> None:
        _gather(foot.values, foot.x, foot.y, field, total)

    if workers is None:
        for foot, total in zip(footprints, out, strict=True):
            one(foot, total)
    else:
        workers.map(one, footprints, out)
    return out


def meet(a: Footprint, b: Footprint) -> bool:
    """Whether two windows share nodes."""
    ha, wa = a.values.shape[:2]
    hb, wb = b.values.shape[:2]
    return bool(a.y < b.y + hb and b.y < a.y + ha and a.x < b.x + wb and b.x < a.x + wa)
