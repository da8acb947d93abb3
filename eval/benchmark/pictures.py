"""The merged cloud of every method, from the same view, with the same details enlarged.

Heights are averaged over all points of a pixel, frames together: where frames do not lie on each
other, edges blur and thin things double, as they would in any map that is made of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from depthba import se3
from depthba.clouds import load_clouds, transform
from depthba.dataset import Dataset
from depthba.trajectory import read_tum
from eval.benchmark.outcome import POSES, Outcome
from eval.benchmark.plan import Job
from eval.methods import entry
from eval.report import three_digits
from eval.self_consistency import map_rotation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

ACROSS = 420
"""Pixels of an overview along its longer side."""
DETAIL = 0.16
"""Side of a detail, as a share of the overview's longer side."""
DENSE = 0.4
"""Share of the densest places' points from which on the ground belongs to the overview."""
FINER = 3
"""Pixels of a detail for one of the overview."""
FRAMES = ("#e6194b", "#111111")
"""Frames of the two details' outlines."""


@dataclass(frozen=True)
class View:
    """A look from above: what lies where in the picture."""

    R_map_world: Floats
    low: Floats
    """(2,), m."""
    high: Floats
    pixel: float
    """m."""
    heights: tuple[float, float]
    """Range of the colours, m."""

    def window(self, low: Floats, high: Floats, finer: int) -> View:
        """Return a part of it, with smaller pixels."""
        return View(self.R_map_world, low, high, self.pixel / finer, self.heights)


def compare(
    dataset: Dataset, poses: Mapping[str, Floats], path: Path, errors: Mapping[str, str]
) -> None:
    """Draw one overview and two details for each method.

    Args:
        dataset: whose frames are merged.
        poses: by method, (N, 4, 4); all are put onto the same frame 0.
        path: the PNG to write.
        errors: by method, what stands below its name.

    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    clouds = [c.points for c in load_clouds(dataset, colours=False)]
    T_true = dataset.T_world_camera_true
    reference = dataset.T_world_camera_measured if T_true is None else T_true
    best = reference if T_true is not None else list(poses.values())[-1]
    view = _view(clouds, best, map_rotation(dataset, reference))
    details = _details(clouds, best, view)
    everyone = dict(poses) if T_true is None else {**poses, "truth": T_true}
    figure = Figure(figsize=(2.6 * len(everyone), 5.6), layout="constrained")
    grid = figure.subplots(
        3, len(everyone), squeeze=False, gridspec_kw={"height_ratios": [_aspect(view), 1, 1]}
    )
    for column, (name, T) in enumerate(everyone.items()):
        world = [
            transform(U, p) for U, p in zip(se3.align_first(T, reference), clouds, strict=True)
        ]
        label = "truth" if name == "truth" else entry(name).label
        grid[0, column].set_title(f"{label}\n{errors.get(name, '')}", fontsize=9)
        _show(grid[0, column], world, view)
        for k, part in enumerate(details):
            corner, size = part.low, part.high - part.low
            grid[0, column].add_patch(
                Rectangle(tuple(corner), *size, fill=False, ec=FRAMES[k], lw=1.3)
            )
            _show(grid[1 + k, column], world, part)
            for spine in grid[1 + k, column].spines.values():
                spine.set(color=FRAMES[k], lw=1.6, visible=True)
    figure.savefig(path, dpi=130)


def of_jobs(
    jobs: Sequence[Job], outcomes: Sequence[Outcome], folder: Path
) -> list[tuple[str, Path]]:
    """Draw the first seed of every scene; return titles and PNG files."""
    folder.mkdir(parents=True, exist_ok=True)
    made, drawn = [], set[str]()
    for job in jobs:
        case = job.case
        mine = [o for o in outcomes if o.dataset == case.name and o.status == "done"]
        if case.group in drawn or not mine:
            continue
        drawn.add(case.group)
        poses = {o.method: read_tum(job.folder(o.method) / POSES)[1] for o in mine}
        errors = {
            o.method: f"{three_digits(1e3 * o.value('translation_mae'))} mm"
            for o in mine
            if np.isfinite(o.value("translation_mae"))
        }
        path = folder / f"clouds-{case.group}.png"
        compare(Dataset.open(case.path), poses, path, errors)
        made.append((f"Merged clouds of {case.group}, seed {case.seed}, and two details", path))
    return made


def _view(clouds: Sequence[Floats], T: Floats, R_map_world: Floats) -> View:
    """Look at the ground that the frames are about: where points lie densest, with a margin."""
    world = [transform(U, p) for U, p in zip(T, clouds, strict=True)]
    points = np.concatenate([p[:: max(1, len(p) // 20000)] for p in world]) @ R_map_world.T
    low, high = np.quantile(points, [0.003, 0.997], axis=0)
    bins = [np.linspace(low[k], high[k], 65) for k in (0, 1)]
    dense, *_ = np.histogram2d(points[:, 0], points[:, 1], bins)
    x, y = np.nonzero(ndimage.median_filter(dense, 3) > DENSE * np.quantile(dense, 0.97))
    corners = [[b[k.min()], b[k.max() + 1]] for b, k in zip(bins, (x, y), strict=True)]
    box = np.array(corners) if len(x) else np.stack([low[:2], high[:2]], axis=1)
    inside = ((points[:, :2] >= box[:, 0]) & (points[:, :2] <= box[:, 1])).all(axis=1)
    heights = np.quantile(points[inside, 2], [0.01, 0.995])
    pixel = float((box[:, 1] - box[:, 0]).max() / ACROSS)
    return View(R_map_world, box[:, 0], box[:, 1], pixel, (float(heights[0]), float(heights[1])))


def _aspect(view: View) -> float:
    width, height = view.high - view.low
    return float(min(max(height / width, 0.5), 2.0))


def _details(clouds: Sequence[Floats], T: Floats, view: View) -> list[View]:
    """Choose two windows full of edges that several frames see, apart from each other."""
    world = [transform(U, p) for U, p in zip(T, clouds, strict=True)]
    heights, counts = _averaged(world, view)
    dense = counts > DENSE * np.quantile(counts, 0.97)
    seen = np.zeros(heights.shape)
    for p in world:
        seen += np.isfinite(_averaged([p], view)[0])
    filled = np.where(np.isfinite(heights), heights, np.nanmedian(heights))
    steep = np.minimum(np.hypot(*np.gradient(filled)), 0.02) * (seen >= 2) * dense
    side = max(int(DETAIL * ACROSS), 8)
    score = ndimage.uniform_filter(steep, side, mode="constant")
    half = side // 2 + 1
    chosen = []
    for _ in FRAMES:
        inner = score[half:-half, half:-half]
        if inner.size == 0 or inner.max() <= 0:
            break
        y, x = np.unravel_index(int(np.argmax(inner)), inner.shape)
        y, x = y + half, x + half
        low = view.low + view.pixel * np.array([x - side / 2, y - side / 2])
        chosen.append(view.window(low, low + side * view.pixel, FINER))
        score[max(y - side, 0) : y + side, max(x - side, 0) : x + side] = 0
    return chosen


def _averaged(world: Sequence[Floats], view: View) -> tuple[Floats, NDArray[np.int64]]:
    """Return the mean height of each pixel (rows y, columns x), m, and its points."""
    width, height = np.ceil((view.high - view.low) / view.pixel).astype(int) + 1
    sums, counts = np.zeros(height * width), np.zeros(height * width, np.int64)
    for p in world:
        q = p @ view.R_map_world.T
        x, y = np.floor((q[:, :2] - view.low) / view.pixel).astype(int).T
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        at = y[inside] * width + x[inside]
        sums += np.bincount(at, q[inside, 2], len(sums))
        counts += np.bincount(at, minlength=len(sums))
    mean = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    return mean.reshape(height, width), counts.reshape(height, width)


def _show(axis: Axes, world: Sequence[Floats], view: View) -> None:
    """Draw heights in colour under a slanting light."""
    from matplotlib import colormaps
    from matplotlib.colors import LightSource, Normalize

    heights, _ = _averaged(world, view)
    holes = ~np.isfinite(heights)
    if holes.all():
        heights = np.zeros_like(heights)
    else:
        nearest = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
        heights = heights[tuple(nearest)]
    gaps = holes & ~ndimage.binary_closing(~holes, iterations=2)
    light = LightSource(azdeg=315, altdeg=40)
    shaded = light.shade(
        heights, colormaps["viridis"], norm=Normalize(*view.heights), blend_mode="soft",
        vert_exag=1.5, dx=view.pixel, dy=view.pixel,
    )  # fmt: skip
    shaded[gaps] = 1.0
    extent = (view.low[0], view.high[0], view.low[1], view.high[1])
    axis.imshow(shaded, origin="lower", extent=extent, interpolation="nearest")
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_visible(False)
