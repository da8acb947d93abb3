"""Pictures of a calibration with a board: what fits, what does not, and what was looked at."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from depthba import durable, se3
from rig.hand_eye.board.calibration import BoardHandEye
from rig.hand_eye.board.chain import errors
from rig.hand_eye.board.views import NextView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

GOOD, BAD, NEXT, QUIET = "#2a7f9e", "#c8322b", "#e08a1e", "#8a8f98"
# Images on a sheet, and how wide they are drawn, px.
SHEET, COLUMNS, WIDE = 12, 4, 640


def residuals(result: BoardHandEye) -> Array:
    """(N, M, 2) px, found less predicted; NaN where a corner was not found."""
    assert result.estimate is not None
    solution = result.estimate.solution
    return -errors(solution.chain, result.observations, solution.problem.velocity)


def images_picture(
    result: BoardHandEye, image_of: Callable[[int], Image | None], path: str | Path
) -> None:
    """Draw images with the corners where the result puts them, and by how much they miss.

    The worst and some others; `image_of` gives the image of a row (height, width, 3).
    """
    assert result.estimate is not None
    away, found = residuals(result), result.estimate
    rows = _some(found.corners, found.dropped)
    columns = min(COLUMNS, len(rows))
    lines = -(-len(rows) // columns)
    sigma = found.solution.problem.noise.corner
    pixels = result.observations.pixels
    figure = _figure(3.4 * columns, 2.15 * lines + 0.5)
    grid = figure.subplots(lines, columns, squeeze=False)
    stretch = _stretch(sigma, pixels)
    for ax, row in zip(grid.ravel(), rows, strict=False):
        image = image_of(row)
        if image is not None:
            ax.imshow(_grey(image), cmap="gray", vmin=0, vmax=255)
        at = pixels[row] - away[row]
        ax.scatter(*at.T, s=9, facecolors="none", edgecolors=GOOD, linewidths=0.8)
        for p, e in zip(at, away[row], strict=True):
            if np.isfinite(e).all():
                far = float(np.linalg.norm(e)) > 4 * sigma
                tip = p + stretch * e
                ax.plot([p[0], tip[0]], [p[1], tip[1]], color=BAD if far else NEXT, linewidth=1.4)
        _zoom(ax, at, result.observations.camera.width, result.observations.camera.height)
        dropped = bool(found.dropped[row])
        name = f"frame {result.observations.ids[row]}"
        ax.set_title(
            f"{name}: {found.corners[row]:.3g} px" + (", left out: robot" if dropped else ""),
            fontsize=9, color=BAD if dropped else "black",
        )  # fmt: skip
        ax.set_xticks([])
        ax.set_yticks([])
    for ax in grid.ravel()[len(rows) :]:
        ax.set_axis_off()
    figure.suptitle(
        f"Corners where the calibration puts them (rings) and what the images say, {stretch:.0f}"
        " times as far away (lines; red: beyond 4 sigma)",
        fontsize=11,
    )
    _save(figure, path)


def residuals_picture(result: BoardHandEye, path: str | Path) -> None:
    """Draw all residuals over the image, their scatter, and each pose's misfit."""
    assert result.estimate is not None
    found = result.estimate
    away, pixels = residuals(result), result.observations.pixels
    noise, camera = found.solution.problem.noise, result.observations.camera
    figure = _figure(15.0, 4.6)
    field, cloud, bars = figure.subplots(1, 3, width_ratios=[1.5, 0.9, 1.6])
    seen = np.isfinite(away).all(axis=-1)
    at, e = pixels[seen], away[seen]
    stretch = _round(0.03 * camera.width / max(3 * noise.corner, 1e-6))
    field.quiver(
        *at.T, *(stretch * e).T, np.linalg.norm(e, axis=1) / noise.corner, angles="xy",
        scale_units="xy", scale=1, cmap="viridis_r", width=0.0022, clim=(0, 4),
    )  # fmt: skip
    field.set(xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal")
    field.set_title(f"Residuals over the image, {stretch:.0f} times enlarged", fontsize=10)
    field.set_xlabel("u (px)")
    field.set_ylabel("v (px)")
    cloud.plot(*e.T, ".", markersize=2, color=GOOD, alpha=0.5)
    turn = np.linspace(0, 2 * np.pi, 100)
    for times in (1, 3):
        cloud.plot(
            times * noise.corner * np.cos(turn), times * noise.corner * np.sin(turn),
            color=QUIET, linewidth=1,
        )  # fmt: skip
    reach = 5 * noise.corner
    cloud.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal")
    outside = int((np.abs(e) > reach).any(axis=1).sum())
    cloud.set_title(
        f"sigma {noise.corner:.3f} px (rings: 1 and 3)"
        + (f", {outside} beyond the edge" if outside else ""),
        fontsize=10,
    )
    cloud.set_xlabel("u (px)")
    cloud.set_ylabel("v (px)")
    _pose_bars(bars, result)
    _save(figure, path)


def _pose_bars(ax: Axes, result: BoardHandEye) -> None:
    assert result.estimate is not None
    found = result.estimate
    limit = float(np.sqrt(6.0))
    misfit = np.sqrt(found.distance)
    top = max(2.2 * limit, 1.15 * float(misfit[~found.dropped].max(initial=0.0)))
    x = np.arange(len(misfit))
    colours = [BAD if gone else GOOD for gone in found.dropped]
    ax.bar(x, np.minimum(misfit, top), color=colours)
    for k in np.flatnonzero(found.dropped):
        ax.text(float(k), top * 1.01, f"{misfit[k]:.0f}", ha="center", color=BAD, fontsize=8)
    ax.axhline(limit, color=QUIET, linewidth=1)
    ax.text(len(x) - 0.45, limit, "expected", va="bottom", ha="right", color=QUIET, fontsize=8)
    ax.set_ylim(0, top * 1.08)
    step = max(1, len(x) // 20)
    ax.set_xticks(x[::step], [str(result.observations.ids[k]) for k in x[::step]], fontsize=8)
    ax.set_xlabel("frame")
    ax.set_ylabel("standard deviations")
    noise = found.solution.problem.noise
    ax.set_title(
        f"The robot's word on each pose against all others\n(robot {1e3 * noise.robot_t:.3f} mm,"
        f" {np.degrees(noise.robot_r):.3f}°; red: left out)",
        fontsize=10,
    )


def coverage_picture(result: BoardHandEye, path: str | Path) -> None:
    """Draw from where the board was seen, what of the image it filled, and how methods differ."""
    camera, pixels = result.observations.camera, result.observations.pixels
    figure = _figure(15.0, 4.8)
    polar = figure.add_subplot(1, 3, 1, projection="polar")
    image, methods = figure.add_subplot(1, 3, 2), figure.add_subplot(1, 3, 3)
    dropped = np.zeros(len(result.P), bool) if result.estimate is None else result.estimate.dropped
    _draw_views(polar, result.P, dropped, result.observations.points, result.next)
    for row in range(len(pixels)):
        ring = _outline(pixels[row])
        image.fill(*ring.T, color=BAD if dropped[row] else GOOD, alpha=0.12, linewidth=0)
        image.plot(*ring.T, color=BAD if dropped[row] else GOOD, linewidth=0.7, alpha=0.8)
    image.set(xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal")
    image.set_title("What of the image the board filled", fontsize=10)
    image.set_xlabel("u (px)")
    image.set_ylabel("v (px)")
    _draw_methods(methods, result)
    _save(figure, path)


def _draw_views(
    ax: Any, P: Array, dropped: NDArray[np.bool_], points: Array, following: NextView | None
) -> None:
    middle = points.mean(axis=0)
    T = se3.inverse(P)
    way = T[:, :3, 3] - middle
    tilt = np.degrees(np.arccos(np.abs(way[:, 2]) / np.linalg.norm(way, axis=1)))
    azimuth = np.arctan2(way[:, 1], way[:, 0])
    # the mark points where the camera's x goes, as seen on the board
    ax.scatter(azimuth, tilt, c=[BAD if d else GOOD for d in dropped], s=28, zorder=3)
    for a, r, R in zip(azimuth, tilt, T[:, :3, :3], strict=True):
        turn = np.arctan2(R[1, 0], R[0, 0])
        p = r * np.array([np.cos(a), np.sin(a)])
        q = p + 5.0 * np.array([np.cos(turn), np.sin(turn)])
        ax.plot([a, np.arctan2(q[1], q[0])], [r, np.hypot(*q)], color=QUIET, linewidth=1)
    if following is not None:
        eye = se3.inverse(following.T_camera_board)[:3, 3] - middle
        ax.scatter(
            np.arctan2(eye[1], eye[0]), np.degrees(following.tilt), marker="*", s=190, color=NEXT,
            zorder=4, label="add next",
        )  # fmt: skip
        ax.legend(loc="lower left", bbox_to_anchor=(-0.15, -0.12), fontsize=9, frameon=False)
    top = max(45.0, float(tilt.max(initial=0.0)) + 6)
    ax.set_rlim(0, top)
    ax.set_rticks([15, 30, 45])
    ax.set_yticklabels(["15°", "30°", "45°"], fontsize=8)
    ax.set_title("From where the board was seen (tilt off its normal;\nticks: camera's x)",
                 fontsize=10)  # fmt: skip


def _draw_methods(ax: Axes, result: BoardHandEye) -> None:
    ax.set_title("Closed forms against this result", fontsize=10)
    if result.T is None or result.covariance is None:
        ax.text(0.5, 0.5, "no result", ha="center", va="center", color=BAD)
        ax.set_axis_off()
        return
    names, size = [], []
    for name, X in result.methods.items():
        if np.isfinite(X).all():
            delta = se3.difference(X, result.T)
            names.append(name)
            size.append([1e3 * np.linalg.norm(delta[:3]), np.degrees(np.linalg.norm(delta[3:]))])
    values = np.array(size)
    y = np.arange(len(names))[::-1]
    sigma = np.sqrt(np.diag(result.covariance))
    ax.barh(y + 0.2, values[:, 0], 0.36, color=GOOD, label="mm away")
    ax.set_yticks(y, names, fontsize=9)
    ax.set_xlabel("mm")
    other = ax.twiny()
    other.barh(y - 0.2, values[:, 1], 0.36, color=NEXT, label="degrees away")
    other.set_xlabel("degrees", color=NEXT)
    own_t = float(1e3 * np.linalg.norm(sigma[:3]))
    own_r = float(np.degrees(np.linalg.norm(sigma[3:])))
    ax.axvline(own_t, color=GOOD, linestyle="--", linewidth=1.2)
    other.axvline(own_r, color=NEXT, linestyle="--", linewidth=1.2)
    ax.set_xlim(0, 1.15 * max(values[:, 0].max(), own_t))
    other.set_xlim(0, 1.15 * max(values[:, 1].max(), own_r))
    ax.set_title(
        f"Closed forms against this result (dashed: its own\nsigma, {own_t:.2f} mm and"
        f" {own_r:.3f}°)",
        fontsize=10,
    )


def _figure(width: float, height: float) -> Figure:
    """Make a figure, in inches, that needs no screen and touches none of pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: str | Path) -> None:
    """Write the figure as PNG, whole or not at all."""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=100, metadata={"Software": None})
    durable.write_bytes(path, out.getvalue())


def _some(corners: Array, dropped: NDArray[np.bool_]) -> Sequence[int]:
    """Rows worth showing, in their order: what was left out, the worst, and others evenly."""
    n = len(corners)
    if n <= SHEET:
        return list(range(n))
    first = [int(k) for k in np.flatnonzero(dropped)[: SHEET // 2]]
    first += [int(k) for k in np.argsort(-corners)[:3]]
    first += [int(k) for k in np.linspace(0, n - 1, SHEET).round()]
    return sorted(list(dict.fromkeys(first))[:SHEET])


def _stretch(sigma: float, pixels: Array) -> float:
    """How much longer residuals are drawn: one sigma is a quarter of the corners' distance."""
    spacing = float(np.nanmedian(np.linalg.norm(np.diff(pixels, axis=1), axis=-1)))
    return _round(max(1.0, spacing / 4 / max(sigma, 1e-6)))


def _round(raw: float) -> float:
    """Return the largest of 1, 2, 5, 10 and so on that is not above."""
    magnitude = 10 ** np.floor(np.log10(raw))
    return float(magnitude * max(m for m in (1, 2, 5) if m * magnitude <= raw))


def _zoom(ax: Axes, at: Array, width: int, height: int) -> None:
    """Show the board and something around it, in the image's shape."""
    low, high = np.nanmin(at, axis=0), np.nanmax(at, axis=0)
    centre, half = (low + high) / 2, 0.62 * (high - low) + 10
    half = np.maximum(half, half[::-1] * [width / height, height / width])
    ax.set_xlim(centre[0] - half[0], centre[0] + half[0])
    ax.set_ylim(centre[1] + half[1], centre[1] - half[1])
    ax.set_aspect("equal")


def _grey(image: Image) -> Image:
    """Light, so that what is drawn on it is seen."""
    grey = image.astype(float).mean(axis=-1) if image.ndim == 3 else image.astype(float)
    return np.asarray(110 + 0.55 * grey, np.uint8)


def _outline(pixels: Array) -> Array:
    """The corners' convex hull (n, 2), closed."""
    from scipy.spatial import ConvexHull

    points = pixels[np.isfinite(pixels).all(axis=-1)]
    hull = ConvexHull(points).vertices
    return np.asarray(points[[*hull, hull[0]]])
