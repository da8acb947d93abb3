"""How certain the poses are: by frame and axis, and how they err together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba.errors import RunError
from depthba.figure import colour_bar, new_figure, save
from depthba.plots.source import Source

Floats = NDArray[np.float64]
AXES = (("x", "#c8492b"), ("y", "#5b9a68"), ("z", "#31688e"))


def correlation(covariance: Floats) -> Floats:
    """Return the correlation matrix of a covariance (m, m); 0 where a variance is 0."""
    sigma = np.sqrt(np.diag(covariance))
    scale = np.where(sigma > 0, 1.0 / np.where(sigma > 0, sigma, 1.0), 0.0)
    return np.asarray(covariance * scale[:, None] * scale)


def draw(source: Source, path: Path) -> dict[str, float]:
    """Draw the standard deviations of the poses by frame, and the correlations of all.

    Returns:
        the largest standard deviations along an axis, m and rad.

    Raises:
        RunError: the run holds no covariance.

    """
    covariance = source.run.covariance
    if covariance is None:
        raise RunError(f"{source.run.path}: has no covariance.npz, expected a run of register")
    sigma = np.sqrt(np.diag(covariance)).reshape(-1, 6)
    ids = source.frame_ids
    weak = _weak(source)
    figure = new_figure(14.0, 7.6)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.35, 1.0))
    rows = (
        (sigma[:, :3], "position (mm)", "One standard deviation: position"),
        (sigma[:, 3:], "orientation (mrad)", "Orientation"),
    )
    for row, (values, what, title) in enumerate(rows):
        ax = figure.add_subplot(grid[row, 0])
        for k, (axis, colour) in enumerate(AXES):
            label = axis if row == 0 else f"about {axis}"
            at = np.arange(len(ids)) + 0.27 * (k - 1)
            ax.bar(at, 1e3 * values[:, k], width=0.27, color=colour, label=label)
        for i, name in enumerate(ids):
            if name in weak:
                ax.axvspan(i - 0.48, i + 0.48, facecolor="#fbf2d8", hatch="//",
                           edgecolor="#eedca4", lw=0, zorder=0)  # fmt: skip
        if _wide(values):
            ax.set_yscale("log")
        thinned = max(1, len(ids) // 25)
        ax.set_xticks(range(0, len(ids), thinned), [str(n) for n in ids[::thinned]])
        ax.set_ylabel(what)
        ax.set_title(title, loc="left", fontweight="bold")
        ax.grid(axis="y", color="#e8e8e8")
        ax.set_axisbelow(True)
        ax.legend(ncols=3, loc="lower right", bbox_to_anchor=(1.0, 0.99), frameon=False)
    ax.set_xlabel("frame" + (", hatched: open along a direction" if weak else ""))
    ax = figure.add_subplot(grid[:, 1])
    shown = ax.imshow(
        correlation(covariance), cmap="RdBu_r", vmin=-1.0, vmax=1.0, interpolation="nearest"
    )
    ticks = np.arange(len(ids))[:: max(1, len(ids) // 12)]
    ax.set_xticks(6 * ticks + 2.5, [str(ids[t]) for t in ticks])
    ax.set_yticks(6 * ticks + 2.5, [str(ids[t]) for t in ticks])
    if len(ids) <= 30:
        for k in range(1, len(ids)):
            ax.axhline(6 * k - 0.5, color="#cccccc", lw=0.5)
            ax.axvline(6 * k - 0.5, color="#cccccc", lw=0.5)
    ax.set_xlabel("frame")
    ax.set_ylabel("frame: x y z, about x y z within each")
    ax.set_title("Which poses err together", loc="left", fontweight="bold")
    colour_bar(figure, shown, [ax], "opposite          correlation          alike")
    worst_t, worst_r = sigma[:, :3].max(), sigma[:, 3:].max()
    told = f"; open: {_told(weak)}" if weak else ""
    figure.suptitle(
        f"{source.name}: known to {1e3 * worst_t:.3g} mm and {1e3 * worst_r:.3g} mrad or better"
        f"{told}",
        fontsize=14,
    )
    save(figure, path, dpi=100)
    return {"largest_sigma_m": float(worst_t), "largest_sigma_rad": float(worst_r)}


def _weak(source: Source) -> dict[int, str]:
    """Return the open directions by frame, in words."""
    weak: dict[int, str] = {}
    for one in source.run.result.get("weak", []):
        weak.setdefault(int(one["frame"]), str(one["name"]))
    return weak


def _told(weak: dict[int, str]) -> str:
    frame, name = next(iter(weak.items()))
    more = f" and {len(weak) - 1} more frames" if len(weak) > 1 else ""
    return f"frame {frame} along {name}{more}"


def _wide(values: Floats) -> bool:
    """Whether the values span so much that only a logarithmic axis shows them all."""
    known = values[values > 0]
    return len(known) > 0 and float(known.max() / known.min()) > 100.0
