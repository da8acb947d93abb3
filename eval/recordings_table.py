"""Reads what many recordings say of themselves into one table, without their clouds and maps."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import LazyChunkStream, RrdReader

from depthba.errors import RunError

METRICS = "/__properties/metrics"
RUN = "/__properties/run"
ERRORS = {
    "translation_mae": "/curves/error/translation",
    "rotation_mae": "/curves/error/rotation",
}
"""Curves in mm and mrad whose last value stands for a figure that the recording does not hold."""


@dataclass(frozen=True)
class Row:
    """One recording."""

    recording: Path
    run: dict[str, Any]
    """Dataset, preset, seed, status, seconds, …, versions; empty where it is not readable."""
    metrics: dict[str, float]
    """By name, in metres and radians."""
    problem: str = ""
    """Why it is not readable; empty where it is."""


def find_recordings(places: Sequence[Path]) -> list[Path]:
    """Return recordings: files as given, all in and below folders.

    Raises:
        RunError: a place does not exist, or there is no recording in any.

    """
    found: list[Path] = []
    for place in places:
        if place.is_dir():
            found += sorted(p for p in place.rglob("*.rrd") if not p.name.startswith("."))
        elif place.exists():
            found.append(place)
        else:
            raise RunError(f"{place}: no such run folder or recording")
    if not found:
        raise RunError(f"{', '.join(map(str, places))}: no recording (.rrd) there")
    return list(dict.fromkeys(found))


def read_rows(files: Iterable[Path]) -> list[Row]:
    """Read recordings; one that is broken gives a row with its reason."""
    return [_read(file) for file in files]


def _read(file: Path) -> Row:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of files without an index, which are read below
            reader = RrdReader(file)
        run = _values(_stream(reader), RUN)
        if not run:
            return Row(file, {}, {}, "holds no result: its run was cut short, or it is not a run's")
        metrics = {k: float(v) for k, v in _values(_stream(reader), METRICS).items()}
        for name, path in ERRORS.items():
            if name not in metrics and (last := _last(_stream(reader), path)) is not None:
                metrics[name] = 1e-3 * last
        return Row(file, run, metrics)
    except (OSError, ValueError, RuntimeError) as error:
        text = str(error).splitlines()[0] if str(error) else repr(error)
        return Row(file, {}, {}, text.rpartition(f"{file}: ")[2] or text)


def _stream(reader: RrdReader) -> LazyChunkStream:
    """Return the chunks, by the file's index where there is one: only those asked for are read."""
    try:
        return reader.store().stream()
    except (ValueError, RuntimeError):
        return reader.stream()


def _values(stream: LazyChunkStream, path: str) -> dict[str, Any]:
    """Return the properties recorded under a path; what was recorded last counts."""
    out: dict[str, Any] = {}
    for chunk in stream.filter(content=[path]):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.startswith("rerun."):
                continue
            for value in batch.column(name).to_pylist():
                if value:
                    out[name] = value[0]
    return out


def _last(stream: LazyChunkStream, path: str) -> float | None:
    """Return the scalar with the highest iteration."""
    best: tuple[int, float] | None = None
    for chunk in stream.filter(content=[path]):
        batch = chunk.to_record_batch()
        if "Scalars:scalars" not in batch.schema.names:
            continue
        values = batch.column("Scalars:scalars").to_pylist()
        for k, v in zip(batch.column("iteration").to_pylist(), values, strict=True):
            if v and (best is None or k >= best[0]) and np.isfinite(v[0]):
                best = k, float(v[0])
    return None if best is None else best[1]
