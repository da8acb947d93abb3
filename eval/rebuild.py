"""Makes the recording of a run anew from the plain files of its folder.

What the archive holds comes back: start and result, their maps, how certain they are, the scalars
of every iteration, the figures. The poses and maps between are gone.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from depthba.dataset import Dataset
from depthba.documents import parse_json
from depthba.errors import RunError
from depthba.options import Options, options_of
from depthba.result import FrameReport, Result, WeakDirection
from depthba.stored_run import Run
from eval.evaluate import open_dataset
from eval.metrics import Metric, start
from eval.recording import Recorder
from eval.review import RECORDING


def rebuild(run: str | os.PathLike[str], dataset: str | os.PathLike[str] | None = None) -> Path:
    """Write run.rrd of a run folder anew.

    Args:
        run: the run folder.
        dataset: the dataset's folder; None: the one that the run remembers.

    Returns:
        The recording.

    Raises:
        RunError: the run is not whole, or its dataset is not there or another one.
        DatasetError: the dataset is damaged.

    """
    opened = Run.open(run)
    data = open_dataset(opened, dataset)
    result = archived_result(opened, data)
    recorder = Recorder(opened.path / RECORDING, data, archived_options(opened))
    try:
        for step in opened.result["history"]:
            recorder.scalars(step)
        recorder.finish(result, archived_metrics(opened.path), opened.result)
    except BaseException:
        recorder.discard()
        raise
    return recorder.path


def archived_result(run: Run, dataset: Dataset) -> Result:
    """Return what a run folder holds of a result; its history is empty.

    Raises:
        RunError: the run is of other frames, or its files contradict each other.

    """
    told = run.result
    try:
        ids = tuple(int(f["frame"]) for f in told["frames"])
        if ids != tuple(frame.id for frame in dataset) or len(ids) != len(run.T_world_camera):
            raise RunError(
                f"{run.path}: its {len(ids)} frames are not the {len(dataset)} of {dataset.path}"
            )
        n = len(ids)
        T_start = run.T_world_camera_start
        return Result(
            status=told["status"],
            reason=told["reason"],
            frame_ids=ids,
            stamps=tuple(run.stamps.tolist()),
            T_world_camera=run.T_world_camera,
            T_world_camera_start=dataset.T_world_camera_measured if T_start is None else T_start,
            depth_map=run.depth_map,
            depth_map_start=run.depth_map if run.depth_map_start is None else run.depth_map_start,
            covariance=np.zeros((6 * n, 6 * n)) if run.covariance is None else run.covariance,
            sigma=_number(told["sigma"]),
            inflation=_number(told["inflation"]),
            fixed_pattern=_number(told.get("fixed_pattern", 0.0)),
            refused_pattern=_number(told.get("refused_pattern", 0.0)),
            history=(),
            weak=tuple(_weak(w) for w in told["weak"]),
            frames=tuple(FrameReport(**f) for f in told["frames"]),
            seconds=told["seconds"],
            overlap=np.array(told["overlap"], dtype=float),
        )
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise RunError(f"{run.path}: result.json is not whole: {error}") from error


def archived_options(run: Run) -> Options:
    """Return the options of a run; those that this version does not know are left out."""
    return options_of(run.config)


def archived_metrics(run: Path) -> list[Metric]:
    """Return what metrics.json of a run folder holds; nothing where there is none.

    Raises:
        RunError: the file is broken.

    """
    file = run / "metrics.json"
    if not file.is_file():
        return []
    try:
        told = parse_json(file.read_text(encoding="utf-8"))

        def read(metrics: dict[str, Any]) -> list[Metric]:
            return [
                Metric(name, m["unit"], m["better"], _number(m["value"]))
                for name, m in metrics.items()
            ]

        return [*read(told["metrics"]), *start(read(told["start"]))]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RunError(f"{file}: not readable: {error!r}") from error


def _weak(told: dict[str, Any]) -> WeakDirection:
    values = {**told, "direction": np.array(told["direction"], dtype=float)}
    for name, kind in get_type_hints(WeakDirection).items():
        if kind is float:
            values[name] = _number(values[name])
    return WeakDirection(**values)


def _number(value: float | None) -> float:
    """Return a number that JSON had to write as null, since it was not finite."""
    return float("nan") if value is None else float(value)
