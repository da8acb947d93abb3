"""Puts several runs of one dataset side by side into one recording.

What is shown of each is computed here, from the frames and the poses alone, on the same cells: a
method that makes no map is judged like one that does.

The k-th run is recorded under ``run/<k>``: ``cam/<i>`` with points by frame and by residual, the
disagreement ``spread`` and the map ``picture`` from above; the start poses come first, as run 0.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from depthba import se3, trajectory
from depthba.clouds import FrameCloud, inside, load_clouds, point_spacing, transform
from depthba.dataset import Dataset
from depthba.depth_map import DepthMap
from depthba.errors import DatasetError, RunError
from depthba.picture import CELL_SPACINGS, SIGMAS, spread_png
from depthba.spread import CellSpread, cell_spread
from depthba.stored_run import read_result
from eval.evaluate import match_stamps
from eval.metrics import Metric, pose_metrics
from eval.recorded_frames import log_cloud, log_frustum, log_pose, shown_clouds
from eval.recorded_map import picture
from eval.recorded_residuals import SPAN, colours, residuals, robust_sigma
from eval.recording_file import RecordingFile
from eval.recording_layout import compare_blueprint, frame_colours
from eval.report import comparison_page
from eval.self_consistency import map_rotation

Floats = NDArray[np.float64]

POINTS = 320_000
"""Of all frames and runs together."""
LEAST_POINTS = 30_000
"""Of the frames of one run, however many there are."""
PICTURE_SIDE = 700
START = "start poses"


@dataclass(frozen=True, eq=False)
class Placement:
    """Where one run put the frames."""

    label: str
    T_world_camera: Floats
    """(N, 4, 4), frame for frame as in the dataset."""
    status: str = ""
    seconds: float | None = None
    iterations: int | None = None


def compare_runs(
    runs: Sequence[Path], path: Path, dataset: str | os.PathLike[str] | None = None
) -> None:
    """Record run folders of one dataset side by side.

    Of a folder only result.json and poses.txt are read, so that folders of other methods do too.

    Args:
        runs: the folders.
        path: the recording to write.
        dataset: the dataset's folder; None: the one that the runs remember.

    Raises:
        RunError: a folder is not a run, or they are runs of different datasets.
        DatasetError: the dataset is damaged.

    """
    if len(runs) < 2:
        raise RunError(f"compare: {len(runs)} run given, expected two or more")
    told = [read_result(run) for run in runs]
    places = [Path(t["dataset"]["path"]) if dataset is None else Path(dataset) for t in told]
    for run, place in zip(runs, places, strict=True):
        if not place.is_dir():
            raise RunError(f"{run}: its dataset {place} is not there; say where with --dataset")
    for run, t, place in zip(runs[1:], told[1:], places[1:], strict=True):
        if t["name"] != told[0]["name"] or _identity(place) != _identity(places[0]):
            raise RunError(
                f"{run}: is of the dataset {t['name']} ({t['dataset']['path']}), expected "
                f"{told[0]['name']} ({told[0]['dataset']['path']}) like {runs[0]}"
            )
    data = Dataset.open(places[0])
    placements = []
    for run, t, label in zip(runs, told, _labels(runs), strict=True):
        file = run / "poses.txt"
        try:
            stamps, T_world_camera = trajectory.read_tum(file)[:2]
        except (OSError, DatasetError) as error:
            raise RunError(f"{file}: not readable: {error}") from error
        order = match_stamps(stamps, data.stamps, f"{data.path}", f"{file}")
        seconds = t.get("seconds") or {}
        placements.append(
            Placement(
                label,
                T_world_camera[order],
                str(t.get("status", "")),
                seconds.get("total", sum(seconds.values()) or None),
                t.get("iterations"),
            )
        )
    roi = (told[0].get("options") or {}).get("roi")
    compare(placements, data, path, roi=roi)


def compare(
    placements: Sequence[Placement],
    dataset: Dataset,
    path: Path,
    roi: Sequence[float] | None = None,
) -> None:
    """Record placements of the same frames side by side, the measured poses first.

    Args:
        placements: what to compare.
        dataset: whose frames.
        path: the recording to write, whole or not at all.
        roi: xmin xmax ymin ymax zmin zmax in the map frame, m; points outside at the measured
            poses are left out.

    """
    T_start = dataset.T_world_camera_measured
    shown = [Placement(START, T_start), *placements]
    T_map_world = se3.make(map_rotation(dataset, T_start), np.zeros(3))
    clouds = []
    for cloud, T in zip(load_clouds(dataset, colours=False), T_start, strict=True):
        keep = inside(transform(T_map_world @ T, cloud.points), roi)
        clouds.append(FrameCloud(cloud.points[keep], None))
    cell = CELL_SPACINGS * point_spacing(dataset, [c.points for c in clouds])
    aligned = [se3.align_first(p.T_world_camera, T_start) for p in shown]
    views = [_View.of(clouds, T, T_map_world, cell) for T in aligned]
    file = RecordingFile(path)
    rec = file.stream
    try:
        rec.send_recording_name(f"{dataset.name}: {len(placements)} runs")
        _log_runs(rec, dataset, clouds, aligned, views)
        rows = [
            (p.label, _figures(T, v.spread, dataset), p.status, p.seconds, p.iterations)
            for p, T, v in zip(shown, aligned, views, strict=True)
        ]
        page = rr.TextDocument(comparison_page(dataset.name, rows), media_type="text/markdown")
        rec.log("figures", page, static=True)
        layout = compare_blueprint([p.label for p in shown], views[-1].depth_map, T_start)
        rec.send_blueprint(layout)
        file.finish()
    except BaseException:
        file.discard()
        raise


@dataclass(frozen=True, eq=False)
class _View:
    """What the frames give at some poses."""

    depth_map: DepthMap
    spread: CellSpread

    @classmethod
    def of(
        cls, clouds: Sequence[FrameCloud], T_world_camera: Floats, T_map_world: Floats, cell: float
    ) -> _View:
        points = [
            transform(T_map_world @ T, c.points)
            for T, c in zip(T_world_camera, clouds, strict=True)
        ]
        return cls(mean_map(points, 0.5 * cell, T_map_world), cell_spread(points, cell))


def mean_map(points_map: Sequence[Floats], spacing: float, T_map_world: Floats) -> DepthMap:
    """Return the mean height of all points about each node.

    Args:
        points_map: per frame (n, 3), map frame, m.
        spacing: of the nodes, m.
        T_map_world: (4, 4), goes into the map as it is.

    """
    p = np.concatenate([*points_map, np.zeros((0, 3))])
    low = p[:, :2].min(axis=0, initial=np.inf) if len(p) else np.zeros(2)
    k = np.rint((p[:, :2] - low) / spacing).astype(np.int64)
    nx, ny = (int(n) + 1 for n in k.max(axis=0, initial=0))
    node = k[:, 1] * nx + k[:, 0]
    count = np.bincount(node, minlength=nx * ny)
    total = np.bincount(node, p[:, 2], minlength=nx * ny)
    heights = np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(ny, nx)
    return DepthMap(
        heights=heights,
        origin=(float(low[0]), float(low[1])),
        spacing=spacing,
        T_map_world=T_map_world,
        count=count.reshape(ny, nx),
        sigma=np.full((ny, nx), np.nan),
    )


def _log_runs(
    rec: rr.RecordingStream,
    dataset: Dataset,
    clouds: Sequence[FrameCloud],
    placed: Sequence[Floats],
    views: Sequence[_View],
) -> None:
    """Record the clouds, maps and disagreements of all runs, in the same colours."""
    tints, camera = frame_colours(len(dataset)), dataset.sensor.camera
    total = max(POINTS // len(placed), LEAST_POINTS)
    few = shown_clouds(dataset, clouds, np.tile(np.eye(4), (len(dataset), 1, 1)), None, total)
    known = views[-1].depth_map.heights[np.isfinite(views[-1].depth_map.heights)]
    low, high = np.quantile(known, [0.01, 0.99]) if len(known) else (0.0, 1.0)
    # a scale that tells the methods apart, on which the start may be red all over
    top = 1e3 * float(np.nanmax([*(v.spread.quantile(0.9) for v in views[1:]), 1e-9]))
    by_run = [
        [residuals(v.depth_map, T, c.points) for T, c in zip(Ts, few, strict=True)]
        for v, Ts in zip(views, placed, strict=True)
    ]
    # one scale for all: what the best of them leaves
    full = SPAN * np.nanmin([*(robust_sigma(np.concatenate(r)) for r in by_run), np.inf])
    for k, (T_world_camera, view) in enumerate(zip(placed, views, strict=True)):
        for i, (T, cloud) in enumerate(zip(T_world_camera, few, strict=True)):
            root = f"run/{k}/cam/{i}"
            log_pose(rec, root, T, static=True)
            log_cloud(rec, f"{root}/points", cloud, tints[i])
            log_cloud(rec, f"{root}/residual", cloud, colours(by_run[k][i], full))
            log_frustum(rec, f"{root}/image", camera, cloud.points, tints[i])
        rec.log(
            f"run/{k}/picture",
            picture(view.depth_map, (float(low), float(high)), PICTURE_SIDE),
            static=True,
        )
        png = spread_png(view.spread, view.depth_map, top, SIGMAS)
        image = rr.EncodedImage(contents=png, media_type="image/png")
        rec.log(f"run/{k}/spread", image, static=True)


def _figures(T_world_camera: Floats, spread: CellSpread, dataset: Dataset) -> list[Metric]:
    """Return errors against truth, where there is one, and how far the frames disagree."""
    true = dataset.T_world_camera_true
    return [
        *([] if true is None else pose_metrics(T_world_camera, true)),
        Metric("spread_median", "m", "lower", spread.quantile(0.5)),
        Metric("spread_p90", "m", "lower", spread.quantile(0.9)),
    ]


def _identity(dataset: Path) -> str:
    """Return what tells a dataset from others, wherever it stands: its list of frames."""
    try:
        return hashlib.sha256((dataset / "frames.jsonl").read_bytes()).hexdigest()
    except OSError as error:
        raise RunError(f"{dataset}: not a dataset: {error.strerror}") from error


def _labels(runs: Sequence[Path]) -> list[str]:
    """Return the shortest ends of the paths that differ from each other."""
    parts = [run.resolve().parts for run in runs]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["/".join(p[-length:]) for p in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{run.name} ({k + 1})" for k, run in enumerate(runs)]
