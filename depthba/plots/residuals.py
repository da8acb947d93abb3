"""How far the points lie off the finished map: where, and in which frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from depthba.depth_map import DepthMap
from depthba.figure import colour_bar, frame_axes, new_figure, save
from depthba.picture import extent, millimetres
from depthba.plots.source import Source

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]
COLOURS = "RdBu_r"
CELL = 2.0
"""Width of a cell in map spacings."""


def off_map(points: Floats, depth_map: DepthMap) -> Floats:
    """Return (n,) how far points (n, 3) of the map frame lie above the map, m, across its slope.

    The height above the bilinear surface over the root of one and the squared slope there. NaN
    beside the map.
    """
    from scipy.ndimage import map_coordinates

    s = depth_map.spacing
    at = (points[:, 1::-1].T - np.array(depth_map.origin[::-1])[:, None]) / s
    slopes = np.gradient(depth_map.heights, s)

    def read(image: Floats) -> Floats:
        return np.asarray(map_coordinates(image, at, order=1, cval=np.nan))

    steep2 = read(slopes[0]) ** 2 + read(slopes[1]) ** 2
    return np.asarray((points[:, 2] - read(depth_map.heights)) / np.sqrt(1.0 + steep2))


def mean_image(points: Sequence[Floats], off: Sequence[Floats], depth_map: DepthMap) -> Floats:
    """Return (ny, nx) the mean of what points are off, by cell of `CELL` spacings; NaN: none."""
    cell = CELL * depth_map.spacing
    ny, nx = (int(np.ceil(n / CELL)) for n in depth_map.shape)
    total, count = np.zeros((ny, nx)), np.zeros((ny, nx))
    for p, r in zip(points, off, strict=True):
        known = np.isfinite(r)
        x, y = (((p[known, :2] - depth_map.origin) / cell) + 0.25).astype(int).T
        x, y = np.minimum(x, nx - 1), np.minimum(y, ny - 1)
        np.add.at(total, (y, x), r[known])
        np.add.at(count, (y, x), 1.0)
    return np.where(count > 0, total / np.maximum(count, 1.0), np.nan)


def draw(source: Source, path: Path) -> dict[str, float]:
    """Draw the residuals over the map and by frame.

    Returns:
        the robust standard deviation of all residuals and the largest median of a frame, m.

    """
    points = source.points_map()
    off = [off_map(p, source.depth_map) for p in points]
    each = [r[np.isfinite(r)] for r in off]
    everything = np.concatenate(each)
    sigma = 1.4826 * float(np.median(np.abs(everything))) if len(everything) else float("nan")
    image = mean_image(points, off, source.depth_map)
    known = np.abs(image[np.isfinite(image)])
    top = 1e3 * max(float(np.quantile(known, 0.9)) if len(known) else 0.0, 2.0 * sigma, 1e-6)

    box = extent(source.depth_map)
    ratio = (box[3] - box[2]) / (box[1] - box[0])
    height = float(np.clip(7.5 * ratio, 3.6, 7.5))
    width = height / ratio + 1.6
    figure = new_figure(width + 5.0, height + 1.2)
    left, right = figure.subplots(1, 2, width_ratios=(width, 5.0))
    ny, nx = image.shape
    (x, y), s = source.depth_map.origin, CELL * source.depth_map.spacing
    edges = (x - 0.25 * s, x + (nx - 0.25) * s, y - 0.25 * s, y + (ny - 0.25) * s)
    shown = left.imshow(
        1e3 * image, extent=edges, origin="lower", cmap=COLOURS, vmin=-top, vmax=top,
        interpolation="nearest",
    )  # fmt: skip
    frame_axes(left, box)
    left.set_xlabel("x (m)")
    left.set_ylabel("y (m)")
    left.set_title("Points against the map, mean of all frames", loc="left", fontweight="bold")
    colour_bar(figure, shown, [left], "below          mean (mm)          above", extend="both")
    _by_frame(right, each, source.frame_ids)
    figure.suptitle(
        f"{source.name}: points lie {millimetres(sigma)} off the map (robust standard deviation)",
        fontsize=14,
    )
    save(figure, path, dpi=100)
    medians = [abs(float(np.median(r))) for r in each if len(r)]
    return {"sigma_m": sigma, "largest_median_m": max(medians, default=float("nan"))}


def _by_frame(ax: Axes, each: Sequence[Floats], names: Sequence[int]) -> None:
    """Draw a box for each frame: half of its points; whiskers: nine tenths."""
    boxes = []
    for name, r in zip(names, each, strict=True):
        low, q1, middle, q3, high = (
            1e3 * np.quantile(r, [0.05, 0.25, 0.5, 0.75, 0.95]) if len(r) else np.full(5, np.nan)
        )
        stats: dict[str, Any] = {
            "med": middle,
            "q1": q1,
            "q3": q3,
            "whislo": low,
            "whishi": high,
            "fliers": [],
        }
        boxes.append(stats | {"label": str(name)})
    ax.bxp(
        boxes, orientation="horizontal", showfliers=False, patch_artist=True, widths=0.7,
        boxprops={"facecolor": "#9db8c9", "edgecolor": "#5d7a8c"},
        medianprops={"color": "#8c2d19", "linewidth": 2},
        whiskerprops={"color": "#5d7a8c"}, capprops={"color": "#5d7a8c"},
    )  # fmt: skip
    ax.axvline(0.0, color="#444444", lw=0.8, zorder=0)
    ax.invert_yaxis()
    ax.grid(axis="x", color="#e2e2e2")
    ax.set_axisbelow(True)
    thinned = max(1, len(names) // 25)
    ax.set_yticks(range(1, len(names) + 1, thinned), [str(n) for n in names[::thinned]])
    ax.set_xlabel("off the map (mm); box: half, whiskers: 90 %")
    ax.set_ylabel("frame")
    ax.set_title("By frame", loc="left", fontweight="bold")
