"""Where the cameras stood, before and after, and how far each was moved."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.figure import new_figure, save
from depthba.plots.source import Source

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]
START, AFTER, TRUE = "#9a9a9a", "#c8492b", "#1d4e6b"


def draw(source: Source, path: Path) -> dict[str, float]:
    """Draw the centres from above and from the side, and the moves of the frames.

    Returns:
        the largest move, m and rad.

    """
    start, after = source.T_world_camera_start, source.T_world_camera
    true = _true(source)
    times = enlarged(after[:, :3, 3], start[:, :3, 3])
    told = "" if times == 1 else f", {times} times as far off"
    figure = new_figure(14.0, 9.0)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.7, 1.0))
    for k, (vertical, title) in enumerate(((1, "From above"), (2, "From the side"))):
        ax = figure.add_subplot(grid[0, k])
        columns = [0, vertical]
        b = after[:, :3, 3][:, columns]
        a = b + times * (start[:, :3, 3][:, columns] - b)
        ax.plot(*b.T, color=AFTER, lw=0.8, alpha=0.4, zorder=1)
        for p, q in zip(a, b, strict=True):
            ax.plot(*np.stack([p, q]).T, color=START, lw=1.4, zorder=2)
        ax.scatter(a[:, 0], a[:, 1], color=START, s=34, zorder=3, label=f"start{told}")
        ax.scatter(b[:, 0], b[:, 1], color=AFTER, s=34, zorder=4, label="after")
        if true is not None:
            c = b + times * (true[:, :3, 3][:, columns] - b)
            label = f"true, frame 0 aligned{told}"
            ax.scatter(c[:, 0], c[:, 1], color=TRUE, marker="+", s=90, zorder=5, label=label)
        _look(ax, after, columns)
        for name, p in zip(source.frame_ids, b, strict=True):
            if k == 0 and (len(b) <= 25 or name == source.frame_ids[0]):
                ax.annotate(
                    f"{name}", p, (5, 5), textcoords="offset points", fontsize=9, color="#444444"
                )
        ax.set_aspect("equal", adjustable="datalim")
        ax.margins(0.12)
        ax.grid(color="#e8e8e8")
        ax.set_axisbelow(True)
        ax.set_xlabel("x (m)")
        ax.set_ylabel(f"{'xyz'[vertical]} (m)")
        ax.set_title(title, loc="left", fontweight="bold")
        if k == 1:
            ax.legend(loc="lower left", framealpha=0.9)
    away = se3.difference(after, start)
    moves = (
        (1e3 * np.linalg.norm(after[:, :3, 3] - start[:, :3, 3], axis=1), "moved by (mm)"),
        (1e3 * np.linalg.norm(away[:, 3:], axis=1), "turned by (mrad)"),
    )
    for k, (values, label) in enumerate(moves):
        ax = figure.add_subplot(grid[1, k])
        ax.bar(range(len(values)), values, color=AFTER, alpha=0.85, label="move")
        if (believed := _believed(source, k)) is not None:
            ax.axhline(believed, color="#444444", ls="--", lw=1.2, label="believed of the start")
            ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=2, frameon=False)
        thinned = max(1, len(values) // 25)
        ax.set_xticks(range(0, len(values), thinned), [str(n) for n in source.frame_ids[::thinned]])
        ax.set_xlabel("frame")
        ax.set_ylabel(label)
        ax.grid(axis="y", color="#e8e8e8")
        ax.set_axisbelow(True)
    figure.suptitle(
        f"{source.name}: {len(after)} frames, moved by up to {moves[0][0].max():.3g} mm and "
        f"{moves[1][0].max():.3g} mrad",
        fontsize=14,
    )
    save(figure, path, dpi=100)
    return {
        "largest_move_m": float(moves[0][0].max()) / 1e3,
        "largest_turn_rad": float(moves[1][0].max()) / 1e3,
    }


def enlarged(after: Floats, start: Floats) -> int:
    """Return how many times the moves (n, 3), m, must be drawn enlarged to be seen."""
    extent = float(np.linalg.norm(np.ptp(after, axis=0)))
    move = float(np.median(np.linalg.norm(start - after, axis=1)))
    most = 0.06 * extent / max(move, 1e-12)
    return max((m * 10**e for e in range(4) for m in (1, 2, 5) if m * 10**e <= most), default=1)


def _look(ax: Axes, T: Floats, columns: list[int]) -> None:
    """Draw which way the cameras look."""
    centres, ahead = T[:, :3, 3][:, columns], T[:, :3, 2][:, columns]
    ax.quiver(
        *centres.T, *ahead.T, color=AFTER, alpha=0.4, angles="xy", width=0.003, scale=14, zorder=2
    )


def _true(source: Source) -> Floats | None:
    """Return the true poses, laid on the estimate's first; None: not known of every frame."""
    found = source.dataset.T_world_camera_true
    if found is None or not np.isfinite(found).all():
        return None
    return se3.align_first(found, source.T_world_camera)


def _believed(source: Source, which: int) -> float | None:
    """Return by how much a start pose was believed to be off, mm or mrad; None: not known."""
    told = (source.options.prior_t, source.options.prior_r)[which]
    if told is not None:
        return 1e3 * float(np.sqrt(3.0)) * told
    noise = source.dataset.pose_noise
    if noise is None:
        return None
    sigma = (noise.sigma_t_m, noise.sigma_r_rad)[which]
    return 1e3 * float(np.linalg.norm(sigma))
