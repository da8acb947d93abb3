"""Pictures of a run: the map as shaded relief, and the spread between frames, before and after."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from depthba.clouds import FrameCloud, inside, load_clouds, point_spacing, transform
from depthba.dataset import Dataset
from depthba.depth_map import DepthMap
from depthba.figure import colour_bar, frame_axes, new_figure, png, save, scale_bar
from depthba.options import Options
from depthba.spread import CellSpread, cell_spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

CELL_SPACINGS = 4.0
"""Width of a cell in point spacings: enough points for a mean, small enough for slopes."""
DARK = "#121212"
SPREADS = "inferno_r"
SIGMAS = "YlOrRd"
"""Seen on dark ground at either end."""
HEIGHTS = (
    (66, 104, 138),
    (104, 158, 160),
    (154, 196, 148),
    (214, 214, 150),
    (226, 178, 116),
    (204, 128, 98),
    (240, 224, 214),
)
"""Colours from low to high, light enough for the shade to be seen on them."""
BEFORE, AFTER = "Before: start poses", "After: depthba"


class Registered(Protocol):
    """What a picture needs of a registration: a `depthba.result.Result` has it."""

    @property
    def status(self) -> str:
        """How it ended."""

    @property
    def depth_map(self) -> DepthMap:
        """The map after."""

    @property
    def depth_map_start(self) -> DepthMap:
        """The map that the start poses give."""

    @property
    def T_world_camera(self) -> Floats:
        """(N, 4, 4), estimated."""

    @property
    def T_world_camera_start(self) -> Floats:
        """(N, 4, 4), where the registration began."""


@dataclass(frozen=True)
class Spreads:
    """Spread between the frames at the start poses and at the estimate."""

    before: CellSpread
    after: CellSpread

    @property
    def top(self) -> float:
        """Where the colours of both end, mm: most of what the start shows."""
        return 1e3 * float(np.nanmax([self.before.quantile(0.9), self.after.quantile(0.5), 1e-6]))


def spreads(
    result: Registered, dataset: Dataset, clouds: Sequence[FrameCloud], roi: Sequence[float] | None
) -> Spreads:
    """Compare the frames cell by cell, in the map frame, at the start and the estimated poses."""
    cell = CELL_SPACINGS * point_spacing(dataset, [c.points for c in clouds])
    T_map_world = result.depth_map.T_map_world

    def at(T_world_camera: Floats) -> CellSpread:
        points = []
        for cloud, T in zip(clouds, T_world_camera, strict=True):
            p = transform(T_map_world @ T, cloud.points)
            points.append(p[inside(p, roi)])
        return cell_spread(points, cell)

    return Spreads(at(result.T_world_camera_start), at(result.T_world_camera))


def map_picture(
    result: Registered,
    dataset: Dataset,
    path: str | Path,
    *,
    options: Options | None = None,
    clouds: Sequence[FrameCloud] | None = None,
) -> None:
    """Draw map.png: the map before and after, and below it the spread between frames.

    Args:
        result: what to draw.
        dataset: its frames.
        path: where to write it, PNG or SVG by its suffix.
        options: the options of the run, for its region of interest.
        clouds: the points of all frames, where the caller has them already.

    """
    clouds = load_clouds(dataset, colours=False) if clouds is None else clouds
    both = spreads(result, dataset, clouds, options.roi if options else None)
    box = extent(result.depth_map)
    width, height = box[1] - box[0], box[3] - box[2]
    panel = np.clip(6.2 * height / width, 2.2, 7.5)
    figure = new_figure(14.5, 2 * panel + 1.6)
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    for ax, depth_map, title in zip(
        axes[0], (result.depth_map_start, result.depth_map), (BEFORE, AFTER), strict=True
    ):
        relief = draw_relief(ax, depth_map, _height_range(result))
        ax.set_title(f"Map. {title}", loc="left", fontweight="bold")
    colour_bar(figure, relief, axes[0], "height (m)")
    for ax, spread, title in zip(axes[1], (both.before, both.after), (BEFORE, AFTER), strict=True):
        image = _draw_spread(ax, spread, both.top)
        ax.set_title(f"Disagreement of frames. {title}", loc="left", fontweight="bold")
        ax.set_title(f"median {millimetres(spread.quantile(0.5))}", loc="right")
    colour_bar(figure, image, axes[1], "spread of the frames' heights (mm)", extend="max")
    for ax in axes.flat:
        frame_axes(ax, box)
    for ax in axes[1]:
        ax.set_xlabel("x (m)")
    for ax in axes[:, 0]:
        ax.set_ylabel("y (m)")
    figure.suptitle(
        f"{dataset.name}: {len(clouds)} frames, map spacing "
        f"{millimetres(result.depth_map.spacing)}, {result.status.replace('_', ' ')}",
        fontsize=14,
    )
    save(figure, path, dpi=100)


def before_after(
    result: Registered,
    dataset: Dataset,
    path: str | Path,
    *,
    options: Options | None = None,
    clouds: Sequence[FrameCloud] | None = None,
) -> None:
    """Draw a compact picture for a page: the map that the start poses give, and the map after.

    Args:
        result: what to draw.
        dataset: its frames.
        path: where to write the PNG.
        options: the options of the run, for its region of interest.
        clouds: the points of all frames, where the caller has them already.

    """
    clouds = load_clouds(dataset, colours=False) if clouds is None else clouds
    both = spreads(result, dataset, clouds, options.roi if options else None)
    box = extent(result.depth_map)
    panel = np.clip(6.2 * (box[3] - box[2]) / (box[1] - box[0]), 2.4, 7.5)
    figure = new_figure(13.6, panel + 0.5)
    axes = figure.subplots(1, 2)
    for ax, depth_map, spread, title in (
        (axes[0], result.depth_map_start, both.before, "Start poses"),
        (axes[1], result.depth_map, both.after, "After depthba"),
    ):
        relief = draw_relief(ax, depth_map, _height_range(result))
        median = millimetres(spread.quantile(0.5))
        ax.set_title(f"{title}: frames disagree by {median}", fontweight="bold")
        frame_axes(ax, box)
        ax.set_xticks([])
        ax.set_yticks([])
        scale_bar(ax, box)
    colour_bar(figure, relief, axes, "height (m)")
    save(figure, path, dpi=100)


def spread_png(
    spread: CellSpread, depth_map: DepthMap, top: float, colours: str = SPREADS
) -> bytes:
    """Return the spread alone as PNG for a dark ground, with colours up to ``top`` mm.

    Where much may lie beyond ``top``, ``colours`` should not end as dark as the ground.
    """
    return _dark_png(
        extent(depth_map),
        lambda ax: _draw_spread(ax, spread, top, colours),
        "spread between frames (mm)",
    )


def sigma_top(depth_map: DepthMap) -> float:
    """Return where the colours of a map's standard deviation end, m: nearly all nodes are below."""
    known = depth_map.sigma[np.isfinite(depth_map.sigma)]
    return float(np.quantile(known, 0.98)) if len(known) else 1.0


def sigma_colours(depth_map: DepthMap, top: float) -> NDArray[np.uint8]:
    """Return the map as relief, (ny, nx, 3), in the colours of its standard deviation up to top."""
    from matplotlib import colormaps

    level = np.clip(np.nan_to_num(depth_map.sigma, nan=top) / max(top, 1e-12), 0.0, 1.0)
    light = np.nan_to_num(shade(depth_map.heights, depth_map.spacing), nan=1.0)[..., None]
    rgb = 255.0 * colormaps[SIGMAS](level)[..., :3] * light
    return np.asarray(np.rint(np.clip(rgb, 0.0, 255.0)), dtype=np.uint8)


def sigma_png(depth_map: DepthMap) -> bytes:
    """Return the standard deviation of the heights as PNG for a dark ground, in mm."""
    ny, nx = depth_map.shape
    x, y, s = *depth_map.origin, depth_map.spacing

    def draw(ax: Axes) -> Any:
        return ax.imshow(
            1e3 * depth_map.sigma,
            extent=(x - 0.5 * s, x + (nx - 0.5) * s, y - 0.5 * s, y + (ny - 0.5) * s),
            origin="lower",
            cmap=SIGMAS,
            vmin=0.0,
            vmax=1e3 * sigma_top(depth_map),
            interpolation="nearest",
        )

    return _dark_png(extent(depth_map), draw, "standard deviation of the height (mm)")


def height_colours(
    heights: Floats, low: float | None = None, high: float | None = None
) -> NDArray[np.uint8]:
    """Return (..., 3) colours from ``low`` to ``high`` m.

    By default 2 % and 98 % of the heights.
    """
    known = heights[np.isfinite(heights)]
    if not len(known):
        return np.full((*heights.shape, 3), 230, np.uint8)
    low = float(np.quantile(known, 0.02)) if low is None else low
    high = float(np.quantile(known, 0.98)) if high is None else high
    level = np.clip((heights - low) / max(high - low, 1e-12), 0.0, 1.0)
    stops = np.linspace(0.0, 1.0, len(HEIGHTS))
    rgb = [np.interp(np.nan_to_num(level), stops, channel) for channel in np.transpose(HEIGHTS)]
    return np.asarray(np.rint(np.stack(rgb, axis=-1)), dtype=np.uint8)


def shade(heights: Floats, spacing: float) -> Floats:
    """Return (ny, nx) brightness, 1 on level ground, of a surface lit from the upper left.

    The slopes are stretched until half of them are steep enough to be seen. NaN stays NaN.
    """
    known = np.isfinite(heights)
    if not known.any() or min(heights.shape) < 2:
        return np.where(known, 1.0, np.nan)
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = heights[tuple(nearest)]  # holes must not darken their rims
    slope_y, slope_x = np.gradient(filled, spacing)
    steep = float(np.median(np.hypot(slope_x, slope_y)[known]))
    stretch = np.clip(0.25 / max(steep, 1e-9), 0.4, 6.0)
    slope_x, slope_y = stretch * slope_x, stretch * slope_y
    light = np.array([-1.0, 1.0, 1.6]) / np.linalg.norm([-1.0, 1.0, 1.6])
    lit = (-slope_x * light[0] - slope_y * light[1] + light[2]) / np.sqrt(
        1 + slope_x**2 + slope_y**2
    )
    return np.where(known, np.clip(lit / light[2], 0.35, 1.25), np.nan)


def relief_image(depth_map: DepthMap, low: float, high: float) -> NDArray[np.uint8]:
    """Return the map as shaded relief, (ny, nx, 4) RGB and alpha, transparent where unseen."""
    colours = height_colours(depth_map.heights, low, high).astype(float)
    light = np.nan_to_num(shade(depth_map.heights, depth_map.spacing))[..., None]
    alpha = 255.0 * np.isfinite(depth_map.heights)[..., None]
    rgba = np.concatenate([np.clip(colours * light, 0.0, 255.0), alpha], axis=-1)
    return np.asarray(np.rint(rgba), dtype=np.uint8)


def millimetres(metres: float) -> str:
    """Return a length for people, three digits: ``0.0152 mm``, ``17.4 mm``."""
    if not np.isfinite(metres):
        return "unknown"
    mm = 1e3 * metres
    digits = 2 - int(np.floor(np.log10(abs(mm)))) if mm else 2
    return f"{mm:.{min(max(digits, 0), 5)}f} mm"


def _dark_png(
    box: tuple[float, float, float, float], draw: Callable[[Axes], Any], label: str
) -> bytes:
    """Return one panel with a colour bar as PNG for a dark ground."""
    from matplotlib import style

    height = float(np.clip(5.6 * (box[3] - box[2]) / (box[1] - box[0]), 2.5, 9.0))
    with style.context("dark_background"):
        figure = new_figure(7.2, height + 0.6, ground=DARK)
        ax = figure.subplots()
        colour_bar(figure, draw(ax), [ax], label, extend="max")
        frame_axes(ax, box)
        ax.set_facecolor(DARK)
        ax.set_xlabel("x (m)")
        ax.set_ylabel("y (m)")
        return png(figure, dpi=100)


def _height_range(result: Registered) -> tuple[float, float]:
    """Return the heights that the colours span, in both maps alike."""
    known = result.depth_map.heights[np.isfinite(result.depth_map.heights)]
    if not len(known):
        return 0.0, 1.0
    low, high = np.quantile(known, [0.02, 0.98])
    return float(low), float(high)


def _draw_spread(ax: Axes, spread: CellSpread, top: float, colours: str = SPREADS) -> Any:
    """Draw the spread in mm."""
    ny, nx = spread.shape
    x, y, s = *spread.origin, spread.cell
    return ax.imshow(
        1e3 * spread.image(),
        extent=(x, x + nx * s, y, y + ny * s),
        origin="lower",
        cmap=colours,
        vmin=0.0,
        vmax=top,
        interpolation="nearest",
    )


def extent(depth_map: DepthMap) -> tuple[float, float, float, float]:
    """Return xmin xmax ymin ymax of what was seen, metres."""
    ys, xs = np.nonzero(np.isfinite(depth_map.heights))
    if not len(ys):
        ny, nx = depth_map.shape
        ys, xs = np.array([0, ny - 1]), np.array([0, nx - 1])
    x, y, s = *depth_map.origin, depth_map.spacing
    return (
        x + s * (xs.min() - 0.5),
        x + s * (xs.max() + 0.5),
        y + s * (ys.min() - 0.5),
        y + s * (ys.max() + 0.5),
    )


def draw_relief(ax: Axes, depth_map: DepthMap, span: tuple[float, float]) -> Any:
    """Draw shaded relief; return something that a colour bar can be made of."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    ny, nx = depth_map.shape
    x, y, s = *depth_map.origin, depth_map.spacing
    edges = (x - 0.5 * s, x + (nx - 0.5) * s, y - 0.5 * s, y + (ny - 0.5) * s)
    ax.imshow(relief_image(depth_map, *span), extent=edges, origin="lower", interpolation="nearest")
    ramp = height_colours(np.linspace(0.0, 1.0, 256), 0.0, 1.0) / 255.0
    return ScalarMappable(Normalize(*span), ListedColormap(ramp.tolist()))
