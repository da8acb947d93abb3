"""What a recording shows of the residuals: points coloured by them, histograms, curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from depthba.clouds import transform
from depthba.depth_map import DepthMap
from depthba.spread import MAD_TO_SIGMA
from eval.recorded_frames import ShownCloud

Floats = NDArray[np.float64]

TOTAL_POINTS = 60_000
"""Points of all frames together that carry a residual."""
COLOUR_BYTES = 3_000_000
"""Once the colours take so much, only the last are recorded."""
SPAN = 3.0
"""Colours and histograms reach so many standard deviations to both sides."""
BINS = 18
SLOT = 0.88
"""Width of a frame's histogram on an axis on which frames are 1 apart."""
BELOW, ON, ABOVE, BESIDE = (50, 110, 255), (238, 238, 232), (255, 70, 40), (70, 70, 74)
"""Colours of points below the map, on it, above it, and where there is none."""


class RecordedResiduals:
    """Records how far the frames' points are from the map, over the iterations."""

    def __init__(
        self,
        rec: rr.RecordingStream,
        clouds: Sequence[ShownCloud],
        colours: NDArray[np.uint8],
    ) -> None:
        """Record, once, which points it is about.

        Args:
            rec: where to.
            clouds: the points of all frames.
            colours: (N, 3), of the frames.

        """
        self._rec = rec
        self._clouds = [c.first(TOTAL_POINTS // max(len(clouds), 1)) for c in clouds]
        self._bytes = 0
        self._colours = colours
        for i, cloud in enumerate(self._clouds):
            points = cloud.points.astype(np.float32)
            shown = rr.Points3D.from_fields(positions=points, radii=cloud.radius)
            rec.log(f"cam/{i}/residual", shown, static=True)

    def log(self, depth_map: DepthMap, T_world_camera: Floats, *, final: bool = False) -> Floats:
        """Record the residuals of a state at the stream's present time.

        Args:
            depth_map: the map.
            T_world_camera: (N, 4, 4).
            final: colour the points in any case.

        Returns:
            (N,), the robust standard deviation of each frame's residuals, m; NaN for a frame
            none of whose points lie over the map.

        """
        by_frame = [
            residuals(depth_map, T, cloud.points)
            for T, cloud in zip(T_world_camera, self._clouds, strict=True)
        ]
        sigma = robust_sigma(np.concatenate([*by_frame, np.zeros(0)]))
        if not sigma > 0:
            return np.full(len(by_frame), np.nan)
        coloured = final or self._bytes < COLOUR_BYTES
        for i, r in enumerate(by_frame):
            if coloured:
                tints = colours(r, SPAN * sigma)
                self._bytes += 4 * len(tints)
                self._rec.log(f"cam/{i}/residual", rr.Points3D.from_fields(colors=tints))
            places, shares, width = histogram(i, r, SPAN * sigma)
            chart = rr.BarChart(
                shares,
                color=self._colours[i],
                abscissa=places,
                widths=np.full(BINS, width, np.float32),
            )
            self._rec.log(f"histogram/{i}", chart)
        return np.array([robust_sigma(r) for r in by_frame])


def residuals(depth_map: DepthMap, T_world_camera: Floats, points: Floats) -> Floats:
    """Return the heights of points above the map, metres; NaN beside the map.

    Args:
        depth_map: the map, interpolated bilinearly.
        T_world_camera: (4, 4).
        points: (n, 3), sensor frame.

    """
    p = transform(depth_map.T_map_world @ T_world_camera, points)
    at = (p[:, :2] - depth_map.origin) / depth_map.spacing
    surface = map_coordinates(depth_map.heights, at[:, ::-1].T, order=1, cval=np.nan)
    return np.asarray(p[:, 2] - surface)


def robust_sigma(r: Floats) -> float:
    """Return 1.4826 times the median magnitude of the finite ones; NaN where there is none."""
    r = r[np.isfinite(r)]
    return MAD_TO_SIGMA * float(np.median(np.abs(r))) if len(r) else float("nan")


def colours(r: Floats, full: float) -> NDArray[np.uint8]:
    """Return (n, 3): blue below the map, pale on it, red above it, grey where ``r`` is NaN.

    Args:
        r: (n,), residuals, m.
        full: residual that takes the full colour, m.

    """
    level = np.clip(np.nan_to_num(r) / full, -1.0, 1.0)
    rgb = [
        np.interp(level, (-1.0, 0.0, 1.0), stops) for stops in zip(BELOW, ON, ABOVE, strict=True)
    ]
    tints = np.rint(np.stack(rgb, axis=1)).astype(np.uint8)
    tints[~np.isfinite(r)] = BESIDE
    return tints


def histogram(frame: int, r: Floats, full: float) -> tuple[Floats, Floats, float]:
    """Return where a frame's bars stand, how high they are, and how wide.

    The bars of frame i stand around i, from ``-full`` at ``i - SLOT / 2`` to ``full`` at
    ``i + SLOT / 2``, so that all frames stand side by side in one chart.

    Args:
        frame: index of the frame.
        r: (n,), residuals, m; what lies beyond ``full`` counts in the outermost bars.
        full: m.

    Returns:
        (BINS,) places, (BINS,) shares of the finite residuals in percent, and a width.

    """
    r = r[np.isfinite(r)]
    counts = np.histogram(np.clip(r, -full, full), BINS, (-full, full))[0]
    width = SLOT / BINS
    places = frame - 0.5 * SLOT + width * (np.arange(BINS) + 0.5)
    return np.asarray(places), 100.0 * counts / max(len(r), 1), width
