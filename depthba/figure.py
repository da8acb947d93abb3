"""What all pictures share: figures that need no screen, bars, frames, whole files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from depthba import durable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EMPTY = "#e9e9ec"


def new_figure(width: float, height: float, ground: str = "white") -> Figure:
    """Make a figure that needs no screen and touches none of pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", facecolor=ground)
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: str | Path, dpi: int) -> None:
    """Write the figure as PNG, or as SVG where the suffix says so, whole or not at all."""
    if Path(path).suffix.lower() == ".svg":
        out = io.BytesIO()
        figure.savefig(out, format="svg", dpi=dpi, metadata={"Date": None})
        durable.write_bytes(path, out.getvalue())
    else:
        durable.write_bytes(path, png(figure, dpi))


def png(figure: Figure, dpi: int) -> bytes:
    """Return the figure as PNG."""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=dpi, metadata={"Software": None})
    return out.getvalue()


def colour_bar(
    figure: Figure, mappable: Any, axes: Any, label: str, extend: str = "neither"
) -> None:
    """Put one colour bar beside some axes."""
    figure.colorbar(mappable, ax=list(axes), label=label, extend=extend, shrink=0.9, pad=0.01)


def frame_axes(ax: Axes, box: tuple[float, float, float, float]) -> None:
    """Fix what all panels share: the same part of the map, true proportions, a quiet ground."""
    ax.set_facecolor(EMPTY)
    ax.set_aspect("equal")
    ax.set_xlim(box[0], box[1])
    ax.set_ylim(box[2], box[3])


def scale_bar(ax: Axes, box: tuple[float, float, float, float]) -> None:
    """Draw a bar of a round length in the lower left corner."""
    width, height = box[1] - box[0], box[3] - box[2]
    exponent = np.floor(np.log10(0.3 * width))
    length = max(m * 10**exponent for m in (1, 2, 5) if m * 10**exponent <= 0.3 * width)
    x, y = box[0] + 0.04 * width, box[2] + 0.05 * height
    ax.plot([x, x + length], [y, y], color="white", lw=6, solid_capstyle="butt")
    ax.plot([x, x + length], [y, y], color="black", lw=3, solid_capstyle="butt")
    text = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm"
    ax.text(
        x + 0.5 * length,
        y + 0.02 * height,
        text,
        ha="center",
        va="bottom",
        bbox={"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1.5},
    )
