"""What changed between two captures of one place: both maps and their difference."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from depthba.change import HeightChange, height_change
from depthba.depth_map import DepthMap
from depthba.figure import colour_bar, frame_axes, new_figure, save
from depthba.picture import draw_relief, extent, millimetres, shade
from depthba.plots.source import Source

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable

COLOURS = "RdBu_r"
FAINT = 0.25


def draw(
    new: Source, old: Source, path: Path, *, as_is: bool = False, least: float | None = None
) -> dict[str, object]:
    """Draw the map before, the map after, and what changed.

    Args:
        new: the run after; all is shown in its map frame.
        old: the run before.
        path: where to.
        as_is: leave in what both differ by as wholes.
        least: difference that counts, m; None: five robust standard deviations.

    Returns:
        the region, areas, volumes, offset and scatter, in m.

    """
    depth_map = new.depth_map
    found = height_change(depth_map, old.depth_map, as_is=as_is, least=least)
    before = replace(depth_map, heights=np.where(np.isfinite(found.old), found.old, np.nan))
    box = extent(depth_map)
    ratio = (box[3] - box[2]) / (box[1] - box[0])
    figure = new_figure(16.0, float(np.clip(4.6 * ratio, 2.6, 9.0)) + 1.7)
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    known = depth_map.heights[np.isfinite(depth_map.heights)]
    span = float(np.quantile(known, 0.02)), float(np.quantile(known, 0.98))
    for ax, shown, title in (
        (axes[0], before, f"Before: {old.run.path.name}"),
        (axes[1], depth_map, f"After: {new.run.path.name}"),
    ):
        relief = draw_relief(ax, shown, span)
        ax.set_title(title, loc="left", fontweight="bold")
    colour_bar(figure, relief, axes[:2], "height (m)")
    image = _draw_change(axes[2], depth_map, found)
    axes[2].set_title("Change", loc="left", fontweight="bold")
    axes[2].set_title(f"what is above ±{millimetres(found.least)}", loc="right", fontsize=10)
    colour_bar(figure, image, [axes[2]], "went          (mm)          came", extend="both")
    for ax in axes:
        frame_axes(ax, box)
        ax.set_xlabel("x (m)")
    axes[0].set_ylabel("y (m)")
    x0, x1, y0, y1 = found.region
    litres = f"{1e3 * found.volume(1):.3g} l came, {1e3 * found.volume(-1):.3g} l went"
    taken = (
        ""
        if as_is
        else f"; {millimetres(found.offset[0])} of height and the tilt of the whole taken off"
    )
    figure.suptitle(
        f"{new.name}: {litres}\ncommon region {found.area:.3g} m², x {x0:.3g} to {x1:.3g}, "
        f"y {y0:.3g} to {y1:.3g} m in the map frame of {new.run.path.name}{taken}",
        fontsize=13,
    )
    save(figure, path, dpi=100)
    return {
        "region_m": list(found.region),
        "area_m2": found.area,
        "changed_m2": float(found.changed.sum()) * found.cell,
        "came_m3": found.volume(1),
        "went_m3": found.volume(-1),
        "offset_m": found.offset[0],
        "tilt": list(found.offset[1:]),
        "sigma_m": found.sigma,
        "least_m": found.least,
    }


def _draw_change(ax: Axes, depth_map: DepthMap, found: HeightChange) -> ScalarMappable:
    """Draw the differences over the relief: in full colour what counts, faint the rest."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    inner = np.abs(found.difference[found.changed])
    top = float(np.quantile(inner, 0.9)) if len(inner) else 2.0 * found.least
    scale = Normalize(-1e3 * top, 1e3 * top)
    ny, nx = depth_map.shape
    x, y, s = *depth_map.origin, depth_map.spacing
    edges = (x - 0.5 * s, x + (nx - 0.5) * s, y - 0.5 * s, y + (ny - 0.5) * s)
    common = np.isfinite(found.difference)
    light = np.nan_to_num(shade(depth_map.heights, s), nan=1.0)
    colours = colormaps[COLOURS](scale(1e3 * np.nan_to_num(found.difference)))[..., :3]
    weight = np.where(found.changed, 1.0, FAINT)[..., None]
    rgb = (weight * colours + (1.0 - weight) * 0.97) * (0.55 + 0.45 * light[..., None])
    rgba = np.concatenate([np.clip(rgb, 0.0, 1.0), common[..., None].astype(float)], axis=-1)
    ax.imshow(rgba, extent=edges, origin="lower", interpolation="nearest")
    return ScalarMappable(scale, colormaps[COLOURS])
