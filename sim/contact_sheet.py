"""One picture of what each stage of the noise does to a frame."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim.noise import staged
from sim.noise.shot import Shot
from sim.noise.stage import Stage
from sim.sensors import DepthSensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

Array = NDArray[np.float64]

PANEL = 430
"""Dots that a panel is wide, about; larger images are thinned, smaller ones enlarged."""

_COLUMNS = 4
_ABOVE, _BELOW, _BESIDE, _HEAD = 58, 34, 104, 84
"""Dots around a panel, for title and law, numbers, and colour bar; above all panels."""
_HOLE = "#00a651"
_EARLIER = "#c8c8c8"
_DPI = 100
_DEPTH_COLOURS = "cividis"
_CHANGE_COLOURS = "RdBu_r"


def contact_sheet(
    path: str | Path,
    title: str,
    sensor: DepthSensor,
    stages: tuple[Stage, ...],
    shot: Shot,
    seed: int,
    frame: int,
) -> None:
    """Write a PNG with a panel for each stage: the change that it alone makes to the depth.

    The first panel is the exact depth, the last what the sensor reports. Equal inputs give equal
    bytes.
    """
    exact = shot.hits.distance
    steps = staged(exact, shot, seed, frame, stages)
    k = -(-sensor.width // PANEL)
    figure, axes = _sheet(len(steps) + 2, sensor.height // k, sensor.width // k)
    figure.text(
        0.008,
        1.0 - 0.2 * _HEAD / (_DPI * figure.get_figheight()),
        f"{title}\nEach panel: the change that this stage alone makes to the depth."
        f" Green: new holes. Grey: holes from before.{_dots(k)}",
        fontsize=15,
        va="top",
    )
    limits = np.nanpercentile(exact, [0.5, 99.5])
    _depth_panel(axes[0], exact, limits, k)
    holes = _share(float(np.mean(np.isnan(exact))))
    _caption(axes[0], "exact depth", "", f"median {np.nanmedian(exact):.2f} m; {holes}")
    before = exact
    for axis, stage, (name, after) in zip(axes[1:], stages, steps, strict=False):
        _change_panel(axis, before, after, k)
        _caption(axis, name, stage.law(sensor), statistics(before, after))
        before = after
    _depth_panel(axes[-1], before, limits, k)
    _caption(axes[-1], "result", "what the sensor reports", statistics(exact, before))
    figure.savefig(path, format="png", metadata={"Software": None})


def _sheet(panels: int, height: int, width: int) -> tuple[Figure, list[Axes]]:
    """A figure with room for so many images; a dot of an image is a whole number of pixels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    zoom = max(1, PANEL // width)
    height, width = zoom * height, zoom * width
    rows = -(-panels // _COLUMNS)
    step = np.array([width + _BESIDE, height + _ABOVE + _BELOW])
    size = step * [_COLUMNS, rows] + [20, _HEAD]
    figure = Figure(figsize=tuple(size / _DPI), dpi=_DPI)
    FigureCanvasAgg(figure)
    axes: list[Axes] = []
    for row, column in np.ndindex(rows, _COLUMNS):
        left = 20 + column * step[0]
        bottom = size[1] - _HEAD - row * step[1] - _ABOVE - height
        box = (left / size[0], bottom / size[1], width / size[0], height / size[1])
        if len(axes) < panels:
            axes.append(figure.add_axes(box))
            axes[-1].set_axis_off()
    return figure, axes


def statistics(before: Array, after: Array) -> str:
    """What a stage does to a depth image (height, width) m, in words.

    Over the pixels that it changes: standard deviation and median size of the change, and their
    share of the image; over the image: the share of new holes.
    """
    change = after - before
    change = change[np.isfinite(change) & (change != 0.0)]
    holes = _share(float(np.mean(np.isnan(after) & np.isfinite(before))))
    if not len(change):
        return f"no depth changed; {holes}"
    touched = 100.0 * len(change) / before.size
    typical = 1e3 * float(np.median(np.abs(change)))
    return (
        f"σ {_short(1e3 * float(np.std(change)))} mm, median size {_short(typical)} mm"
        f" on {_short(touched)} %; {holes}"
    )


def _share(holes: float) -> str:
    return f"holes {_short(100.0 * holes)} %" if holes else "no holes"


def _short(x: float) -> str:
    """Two digits, but never an exponent."""
    return f"{x:.0f}" if x >= 99.5 else f"{x:.2g}"


def _dots(k: int) -> str:
    return "" if k == 1 else f" Each dot: the strongest of {k} x {k} pixels."


def _caption(axis: Axes, name: str, law: str, numbers: str) -> None:
    axis.annotate(
        name, (0, 1), (0, 20), "axes fraction", "offset points", fontsize=14, fontweight="bold"
    )
    axis.annotate(law, (0, 1), (0, 5), "axes fraction", "offset points", fontsize=11)
    axis.annotate(numbers, (0, 0), (0, -5), "axes fraction", "offset points", fontsize=11, va="top")


def _depth_panel(axis: Axes, depth: Array, limits: Array, k: int) -> None:
    thin = _blocks(depth, k)[..., k * k // 2]
    image = axis.imshow(
        np.ma.masked_invalid(thin),
        cmap=_DEPTH_COLOURS,
        vmin=limits[0],
        vmax=limits[1],
        interpolation="nearest",
    )
    _hole_dots(axis, np.isnan(thin), _HOLE)
    _bar(axis, image, "m")


def _change_panel(axis: Axes, before: Array, after: Array, k: int) -> None:
    change = 1e3 * (after - before)
    touched = np.abs(change[np.isfinite(change) & (change != 0.0)])
    scale = 3.0 * float(np.median(touched)) if len(touched) else 1.0
    image = axis.imshow(
        np.ma.masked_invalid(_strongest(change, k)),
        cmap=_CHANGE_COLOURS,
        vmin=-scale,
        vmax=scale,
        interpolation="nearest",
    )
    _hole_dots(axis, np.all(_blocks(np.isnan(before), k), axis=-1), _EARLIER)
    lost = np.isnan(after) & np.isfinite(before)
    _hole_dots(axis, np.any(_blocks(lost, k), axis=-1), _HOLE)
    if len(touched):
        _bar(axis, image, "mm")


def _bar(axis: Axes, image: AxesImage, unit: str) -> None:
    bar = axis.figure.colorbar(image, cax=axis.inset_axes((1.02, 0.0, 0.035, 1.0)))
    bar.ax.set_title(unit, fontsize=11)
    bar.ax.tick_params(labelsize=10)


def _hole_dots(axis: Axes, where: NDArray[np.bool_], colour: str) -> None:
    from matplotlib.colors import ListedColormap

    dots = np.ma.masked_where(~where, np.ones(where.shape))
    axis.imshow(dots, cmap=ListedColormap([colour]), vmin=0, vmax=1, interpolation="nearest")


def _blocks(image: NDArray, k: int) -> NDArray:
    """The k x k pixels of each dot, along the last axis: (height / k, width / k, k^2)."""
    rows, columns = image.shape[0] // k, image.shape[1] // k
    blocks = image[: rows * k, : columns * k].reshape(rows, k, columns, k)
    return blocks.swapaxes(1, 2).reshape(rows, columns, k * k)


def _strongest(change: Array, k: int) -> Array:
    """Of each dot's pixels the largest change, either way; NaN where all are holes."""
    blocks = _blocks(change, k)
    at = np.argmax(np.where(np.isnan(blocks), -1.0, np.abs(blocks)), axis=-1)
    return np.asarray(np.take_along_axis(blocks, at[..., None], axis=-1)[..., 0])
