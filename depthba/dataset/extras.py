"""markers.json and calibration.json: what some datasets have beside their frames."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from depthba.dataset import fields
from depthba.dataset.faults import Faults, MalformedError
from depthba.dataset.model import Marker
from depthba.errors import DatasetError
from depthba.trajectory import read_text

MARKERS = "markers.json"
CALIBRATION = "calibration.json"


def read_markers(root: Path, ids: Collection[int], faults: Faults) -> tuple[Marker, ...]:
    """Return the markers of a dataset with frames ``ids``; empty without markers.json."""
    raw = _read_json(root, MARKERS, faults)
    if raw is None:
        return ()
    if not isinstance(raw, list):
        faults.add(MARKERS, None, f"it is {fields.shown(raw)}, expected a list of markers")
        return ()
    markers: list[Marker] = []
    for index, value in enumerate(raw):
        with faults.within(MARKERS):
            marker = _marker(value, f"[{index}]", ids, faults)
            if any(marker.name == other.name for other in markers):
                raise MalformedError(
                    f"marker {marker.name!r} is there twice, expected names that differ"
                )
            markers.append(marker)
    return tuple(markers)


def markers_json(markers: Sequence[Marker], ids: Collection[int]) -> list[dict[str, Any]]:
    """Return what markers.json holds for these markers. `MalformedError`: it could not be read."""
    raw = [
        {
            "name": marker.name,
            "p_world": [float(v) for v in marker.p_world],
            "observations": [
                {"frame": int(frame), "p_camera": [float(v) for v in p_camera]}
                for frame, p_camera in marker.observations
            ],
        }
        for marker in markers
    ]
    faults = Faults(Path(), strict=False)
    for index, value in enumerate(raw):
        _marker(value, f"[{index}]", ids, faults)
    if faults.found:
        raise MalformedError(str(faults.found[0]))
    return raw


def read_calibration(root: Path, faults: Faults) -> dict[str, Any] | None:
    """Return calibration.json, board and truth checked, or None where there is none."""
    raw = _read_json(root, CALIBRATION, faults)
    if raw is None:
        return None
    with faults.within(CALIBRATION):
        return _calibration(raw, faults)
    return None


def calibration_json(calibration: Mapping[str, Any]) -> dict[str, Any]:
    """Return what calibration.json holds; transforms may be arrays (4, 4).

    `MalformedError`: it could not be read.
    """
    raw = {
        key: value.tolist() if isinstance(value, np.ndarray) else value
        for key, value in calibration.items()
    }
    try:
        raw = fields.parse(json.dumps(raw, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise MalformedError(f"no JSON: {error}") from error
    faults = Faults(Path(), strict=False)
    _calibration(raw, faults)
    if faults.found:
        raise MalformedError(faults.found[0].text)
    return dict(raw)


def _calibration(raw: Any, faults: Faults) -> dict[str, Any]:
    record = fields.mapping(raw, "it")
    for key in ("T_flange_camera_true", "T_base_board_true"):
        with faults.within(CALIBRATION):
            if record.get(key) is not None:
                fields.rigid(record[key], key)
    if record.get("board") is not None:
        board = fields.mapping(record["board"], "board")
        for key in ("columns", "rows"):
            with faults.within(CALIBRATION):
                if key in board:
                    fields.integer(board[key], f"board.{key}", least=1)
        with faults.within(CALIBRATION):
            if "square_m" in board:
                fields.number(board["square_m"], "board.square_m", above=0)
    return record


def _read_json(root: Path, file: str, faults: Faults) -> Any:  # JSON is untyped until it is checked
    path = root / file
    if not path.exists():
        return None
    try:
        text = read_text(path)
    except DatasetError as error:
        if faults.strict:
            raise
        faults.add(file, None, str(error).removeprefix(f"{path}: "))
        return None
    with faults.within(file):
        return fields.parse(text)
    return None


def _marker(value: Any, where: str, ids: Collection[int], faults: Faults) -> Marker:
    record = fields.mapping(value, where)
    name = fields.text(fields.required(record, "name"), f"{where}.name")
    p_world = np.array(
        fields.numbers(fields.required(record, "p_world"), f"{name}.p_world", length=3)
    )
    observations = record.get("observations", [])
    if not isinstance(observations, list):
        raise MalformedError(
            f"{name}.observations is {fields.shown(observations)}, expected a list"
        )
    seen = []
    for observation in observations:
        frame: int | None = None
        with faults.within(MARKERS):
            raw = fields.mapping(observation, f"observation of {name!r}")
            frame = fields.integer(fields.required(raw, "frame"), f"{name}.frame")
            if frame not in ids:
                raise MalformedError(
                    f"marker {name!r} is seen in frame {frame}, which is not in the dataset"
                )
            p_camera = fields.numbers(
                fields.required(raw, "p_camera"), f"{name}.p_camera in frame {frame}", length=3
            )
            seen.append((frame, np.array(p_camera)))
    return Marker(name, p_world, tuple(seen))
