"""Judges a run: against truth where there is one, and by how well its frames agree in any case."""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import durable, se3
from depthba.clouds import inside, load_clouds, point_spacing, transform
from depthba.convert import Reading, pose_files
from depthba.dataset import Dataset
from depthba.depth_map import DepthMap
from depthba.errors import DatasetError, OptionError, RunError
from depthba.options import options_of
from depthba.picture import CELL_SPACINGS
from depthba.selecting import selected
from depthba.stored_run import Run
from eval.bound import Bound
from eval.bound import bound as cramer_rao
from eval.map_metrics import cloud_metrics, height_metrics, patches, seen_nodes
from eval.marker_metrics import marker_metrics
from eval.metrics import Metric, consistency, over_bound, pose_metrics, start
from eval.review import RECORDING
from eval.self_consistency import agreement, map_rotation
from eval.true_map import TrueSurface

Floats = NDArray[np.float64]

PATCH_CELLS = 1.5
"""Radius of the neighbourhoods in which the common cloud's sharpness is judged, in cells."""
SAME_STAMP = 1e-6
"""Stamps that differ by no more than this, s, are one frame."""
MAX_GAP = Reading().max_gap
"""True poses of a file are interpolated over no longer a gap than this, s, as by `convert`."""


@dataclass(frozen=True)
class Evaluation:
    """All figures of one run."""

    run: Run
    dataset: Dataset
    metrics: tuple[Metric, ...]
    """Of the estimate."""
    start_metrics: tuple[Metric, ...]
    """Of the start poses, under the same names."""
    cell: float
    """Edge of the cells in which frames are compared, m."""
    shared_cells: int
    """Cells that two or more frames see, at the estimate."""
    pairs: int
    """Overlapping pairs of frames, at the estimate."""
    true_frames: tuple[int, ...]
    """Ids of the frames with truth, the first of which was put onto it; empty: there is none."""
    nees_dof: int | None
    """Degrees of freedom behind the consistency figure; None without truth or covariance."""
    bound: Bound | None
    """The least error that the noise allows; None where it was not asked for."""
    seconds: float
    """That the judging took."""


def evaluate(
    run: str | os.PathLike[str],
    dataset: str | os.PathLike[str] | None = None,
    truth: str | os.PathLike[str] | None = None,
    cell: float | None = None,
    bound: bool = False,
    max_gap: float = MAX_GAP,
) -> list[Metric]:
    """Judge a run and leave metrics.json and report.md in its folder.

    Args:
        run: the run folder.
        dataset: the dataset's folder; None: the one that the run remembers.
        truth: a file of true poses, TUM, interpolated at the frames' stamps; only frames that have
            a pose then count. None: the dataset's own, if it has any.
        cell: edge of the cells in which frames are compared, m; None: four point spacings.
        bound: whether to compute the Cramér-Rao bound too, and the errors over it.
        max_gap: poses of ``truth`` are interpolated over no longer a gap, s.

    Returns:
        The metrics of the estimate, then those of the start poses, named ``start_...``.

    Raises:
        RunError: the run or its dataset is missing, or they do not belong together.
        DatasetError: the dataset or the truth is wrong, or says too little for a bound.
        OptionError: ``cell`` or ``max_gap`` makes no sense.

    """
    judged = save(run, dataset, truth, cell, bound, max_gap)
    return [*judged.metrics, *start(judged.start_metrics)]


def save(
    run: str | os.PathLike[str],
    dataset: str | os.PathLike[str] | None = None,
    truth: str | os.PathLike[str] | None = None,
    cell: float | None = None,
    bound: bool = False,
    max_gap: float = MAX_GAP,
) -> Evaluation:
    """Judge a run and leave metrics.json and report.md in its folder; see `evaluate`.

    A recording there gets the figures too.
    """
    from eval.report import report  # which needs this module's types

    judged = judge(run, dataset, truth, cell, bound, max_gap)
    durable.write_json(judged.run.path / "metrics.json", as_json(judged))
    durable.write_text(judged.run.path / "report.md", report(judged))
    recording = judged.run.path / RECORDING
    if recording.is_file() and importlib.util.find_spec("rerun") is not None:
        from eval.recording import add_figures  # rerun takes a second to import

        figures = [*judged.metrics, *start(judged.start_metrics)]
        add_figures(recording, judged.run.result, figures)
    return judged


def judge(
    run: str | os.PathLike[str],
    dataset: str | os.PathLike[str] | None = None,
    truth: str | os.PathLike[str] | None = None,
    cell: float | None = None,
    bound: bool = False,
    max_gap: float = MAX_GAP,
) -> Evaluation:
    """Compute all figures of a run; see `evaluate`. Writes nothing."""
    began = time.perf_counter()
    if cell is not None and not (np.isfinite(cell) and cell > 0):
        raise OptionError(f"cell: {cell} m, expected a length above 0")
    if not (np.isfinite(max_gap) and max_gap > 0):
        raise OptionError(f"max_gap: {max_gap} s, expected a time above 0")
    opened = Run.open(run)
    data = open_dataset(opened, dataset)
    rows = match_stamps(data.stamps, opened.stamps, f"{opened.path / 'poses.txt'}", f"{data.path}")
    T_est, T_start = opened.T_world_camera, opened.T_world_camera_start
    T_measured = data.T_world_camera_measured[rows]
    if T_start is None:
        T_start = T_measured
    known, T_true = _truth(data, rows, opened, truth, max_gap)

    metrics: list[Metric] = []
    before: list[Metric] = []
    dof = None
    if T_true is not None:
        metrics += pose_metrics(T_est[known], T_true)
        before += pose_metrics(T_start[known], T_true)
        if opened.covariance is not None and len(known) > 1:
            of_known = (6 * known[:, None] + np.arange(6)).ravel()
            covariance = opened.covariance[np.ix_(of_known, of_known)]
            judged = consistency(T_est[known], T_true, covariance)
            metrics.append(Metric("nees_per_dof", "1", "one", judged.nees_per_dof))
            dof = judged.dof
    least = None
    if bound:
        least = _bound(data, rows, known, T_true, opened)
        metrics += over_bound(metrics, least.translation, least.rotation)

    clouds = load_clouds(data, colours=False)
    points = [_within_range(data, clouds[k].points) for k in rows]
    if cell is None:
        cell = CELL_SPACINGS * point_spacing(data, points)
    # a file's world may be another than the one in which region and axes are meant
    reference = T_measured if T_true is None or truth is not None else T_true
    agreements = [
        agreement(
            points,
            se3.align_first(T, reference),
            map_rotation(data, reference),
            cell,
            roi=opened.config.get("roi"),
            T_map_world=opened.depth_map.T_map_world,
        )
        for T in (T_start, T_est)
    ]
    markers, ids = data.markers(), [data.ids[k] for k in rows]
    for T, agreed, figures in zip((T_start, T_est), agreements, (before, metrics), strict=True):
        figures += agreed.metrics()
        figures += patches(points, T, PATCH_CELLS * cell).metrics()
        figures += marker_metrics(markers, ids, T)
    surface = None if T_true is None else TrueSurface.of(data)
    if T_true is not None and surface is not None:
        world = [transform(T, points[k]) for k, T in zip(known, T_true, strict=True)]
        roi = opened.config.get("roi")
        for depth_map, T, figures in (
            (opened.depth_map_start, T_start, before),
            (opened.depth_map, T_est, metrics),
        ):
            if depth_map is not None:
                T_true_world = T_true[0] @ se3.inverse(T[known[0]])
                figures += _map_metrics(depth_map, T_true_world, surface, world, roi)
    return Evaluation(
        run=opened,
        dataset=data,
        metrics=tuple(metrics),
        start_metrics=tuple(before),
        cell=cell,
        shared_cells=len(agreements[1].spread.shared),
        pairs=len(agreements[1].pairs),
        true_frames=tuple(ids[k] for k in known),
        nees_dof=dof,
        bound=least,
        seconds=time.perf_counter() - began,
    )


def _map_metrics(
    found: DepthMap,
    T_true_world: Floats,
    surface: TrueSurface,
    world: Sequence[Floats],
    roi: Sequence[float] | None,
) -> list[Metric]:
    """Judge a map by the true surface.

    Args:
        found: the map.
        T_true_world: (4, 4), puts the world of its poses onto the true one.
        surface: the truth.
        world: the points of each frame (n_i, 3) at its true pose: where they are, the map should
            have heights.
        roi: region of interest in the map frame; nodes outside do not count.

    """
    grid = found.origin, found.spacing, found.shape
    T_true_map = T_true_world @ se3.inverse(found.T_map_world)
    T_map_true = se3.inverse(T_true_map)
    true = surface.heights(T_true_map, *grid)
    expected = seen_nodes(world, T_map_true, *grid)
    if roi is not None:
        p_map = replace(found, heights=true, T_map_world=np.eye(4)).vertices()
        expected &= inside(p_map.reshape(-1, 3), roi).reshape(found.shape)
    clouds = []
    for z in (found.heights, true):
        there = replace(found, heights=np.where(expected, z, np.nan)).vertices()
        clouds.append(there[np.isfinite(there).all(axis=-1)])
    return [
        *height_metrics(found.heights, true, expected, found.spacing),
        *cloud_metrics(*clouds),
    ]


def as_json(judged: Evaluation) -> dict[str, Any]:
    """Return what metrics.json holds: name to value, unit, direction; unknown values are null."""

    def figures(metrics: Sequence[Metric]) -> dict[str, Any]:
        return {
            m.name: {
                "value": m.value if np.isfinite(m.value) else None,
                "unit": m.unit,
                "better": m.better,
            }
            for m in metrics
        }

    return {
        "format": "depthba-metrics",
        "version": 1,
        "run": judged.run.path.resolve().name,
        "dataset": judged.dataset.name,
        "metrics": figures(judged.metrics),
        "start": figures(judged.start_metrics),
        "cell": judged.cell,
        "shared_cells": judged.shared_cells,
        "pairs": judged.pairs,
        "frames_with_truth": list(judged.true_frames),
        "nees_dof": judged.nees_dof,
        "bound": None
        if judged.bound is None
        else {k: getattr(judged.bound, k) for k in ("spacing", "sigma", "surface")},
        "seconds": judged.seconds,
    }


def open_dataset(run: Run, path: str | os.PathLike[str] | None) -> Dataset:
    """Open the dataset of a run, or the one given in its place."""
    if path is None and not run.dataset_path.is_dir():
        raise RunError(
            f"{run.path}: its dataset {run.dataset_path} is not there; say where with --dataset"
        )
    dataset = Dataset.open(run.dataset_path if path is None else Path(path))
    return selected(dataset, options_of(run.config))


def match_stamps(have: Floats, want: Floats, wanted_by: str, owner: str) -> NDArray[np.int64]:
    """Return for each stamp of ``want`` the index of the equal stamp in ``have``."""
    if not len(have):
        raise RunError(f"{owner}: holds no frames")
    order = np.argsort(have)
    place = np.clip(np.searchsorted(have[order], want), 1, len(have) - 1) if len(have) > 1 else None
    if place is None:
        nearest = np.zeros(len(want), np.int64)
    else:
        left, right = order[place - 1], order[place]
        nearest = np.where(np.abs(have[left] - want) <= np.abs(have[right] - want), left, right)
    apart = np.abs(have[nearest] - want)
    if np.any(apart > SAME_STAMP):
        worst = want[np.argmax(apart)]
        raise RunError(f"{wanted_by}: stamp {worst:.6f} s, expected one of the frames in {owner}")
    return np.asarray(nearest, dtype=np.int64)


def _within_range(data: Dataset, points: Floats) -> Floats:
    """Leave out the very ends of the range of a depth sensor, where sensors clip."""
    sensor = data.sensor
    if sensor.kind != "depth":
        return points
    low = 0.0 if sensor.depth_min is None else sensor.depth_min
    high = np.inf if sensor.depth_max is None else sensor.depth_max
    return points[(points[:, 2] > low) & (points[:, 2] < high)]


def _bound(
    data: Dataset,
    rows: NDArray[np.int64],
    known: NDArray[np.int64],
    T_true: Floats | None,
    run: Run,
) -> Bound:
    """Return the bound at the run's own map spacing and region of interest."""
    if len(rows) != len(data):
        raise RunError(
            f"{run.path}: {len(rows)} of the {len(data)} frames in {data.path}; "
            "the bound is for all of them"
        )
    if T_true is not None and len(known) != len(rows):
        raise RunError(
            f"{run.path}: {len(known)} of {len(rows)} frames have truth; the bound is for all of "
            "them"
        )
    roi = run.config.get("roi")
    truth = None
    if T_true is not None:
        truth = np.empty_like(T_true)
        truth[rows] = T_true
    return cramer_rao(
        data,
        float(run.result["map"]["spacing"]),
        roi=None if roi is None else tuple(roi),
        truth=truth,
    )


def _truth(
    data: Dataset,
    rows: NDArray[np.int64],
    run: Run,
    path: str | os.PathLike[str] | None,
    max_gap: float,
) -> tuple[NDArray[np.int64], Floats | None]:
    """Return which of the run's frames have true poses, (M,), and those, (M, 4, 4), or None."""
    if path is None:
        true = data.T_world_camera_true
        return (np.arange(0), None) if true is None else (np.arange(len(rows)), true[rows])
    poses = pose_files.read(Path(path))
    if poses.stamps is None:
        raise DatasetError(
            f"{path}: poses without stamps, expected TUM: stamp tx ty tz qx qy qz qw"
        )
    found = [poses.at(float(stamp), max_gap) for stamp in run.stamps]
    known = np.array([k for k, T in enumerate(found) if T is not None], dtype=np.int64)
    if len(known) < min(2, len(found)):
        raise RunError(
            f"{path}: stamps {poses.stamps.min():.6f} to {poses.stamps.max():.6f} s, but the "
            f"frames of {run.path} are of {run.stamps.min():.6f} to {run.stamps.max():.6f} s, and "
            f"{len(known) or 'none'} of {len(found)} "
            f"{'has' if len(known) else 'have'} poses within {max_gap:g} s on both sides: "
            "expected truth for two frames or more"
        )
    return known, np.array([T for T in found if T is not None])
