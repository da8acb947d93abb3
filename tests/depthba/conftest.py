"""A small dataset that tests copy and spoil."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from depthba import se3
from depthba.dataset import DatasetWriter, Marker

SENSOR: dict[str, Any] = {
    "kind": "depth",
    "model": "made-up",
    "width": 8,
    "height": 6,
    "fx": 7.0,
    "fy": 7.5,
    "cx": 3.5,
    "cy": 2.5,
    "distortion": [0, 0, 0, 0, 0],
    "depth_scale": 0.001,
    "depth_min": 0.5,
    "depth_max": 3.0,
    "noise": {"sigma_m": 0.002, "power": 2, "along": "z"},
}


class SmallDataset:
    """A dataset folder with everything in it, and ways to change its files by hand."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @staticmethod
    def header() -> dict[str, Any]:
        return {"name": "small", "sensor": dict(SENSOR), "seed": 3}

    @staticmethod
    def frame(i: int) -> dict[str, Any]:
        """Return what frame ``i`` is written with: the arguments of `DatasetWriter.add_frame`."""
        T = se3.make(se3.exp_so3([0.1 * i, 0.2, 3.0]), [i, 2, 1])
        return {
            "stamp": 10 + 0.5 * i,
            "depth": np.arange(48).reshape(6, 8) * 0.05 + 0.4 + 0.1 * i,
            "rgb": np.full((6, 8, 3), [200, 100, 10 * i], np.uint8),
            "T_world_camera": T,
            "T_world_camera_true": se3.retract(T, [0.01, 0, 0, 0, 0, 0.01]),
            "joints": [0.1 * i] * 6,
            "T_base_flange": np.eye(4),
        }

    @classmethod
    def write(cls, path: Path, frames: int = 3) -> SmallDataset:
        writer = DatasetWriter.create(path, cls.header())
        for i in range(frames):
            writer.add_frame(**cls.frame(i))
        if frames:
            seen = ((0, np.array([0.1, 0.2, 1])),)
            writer.write_markers([Marker("origin", np.zeros(3), seen)])
        return cls(path)

    def content(self, file: str, data: bytes | str | None, frame: int | None = None) -> None:
        """Replace or remove a file; with ``frame``, its sha256 in frames.jsonl is made to agree."""
        if data is None:
            (self.path / file).unlink()
            return
        raw = data.encode() if isinstance(data, str) else data
        (self.path / file).write_bytes(raw)
        if frame is not None:
            lines = (self.path / "frames.jsonl").read_text().splitlines()
            hashes = json.loads(lines[frame])["sha256"]
            hashes[file.split("/")[0]] = hashlib.sha256(raw).hexdigest()
            self.record(frame, sha256=hashes)

    def change(self, **changes: Any) -> None:
        """Change dataset.json; `sensor__key` reaches into the sensor, None takes a key out."""
        raw = json.loads((self.path / "dataset.json").read_text())
        for key, value in changes.items():
            inner, _, name = key.rpartition("__")
            target = raw[inner] if inner else raw
            if value is None:
                del target[name]
            else:
                target[name] = value
        self.content("dataset.json", json.dumps(raw))

    def record(self, frame: int, **changes: Any) -> None:
        """Change keys of one line of frames.jsonl; None takes a key out."""
        raw = json.loads((self.path / "frames.jsonl").read_text().splitlines()[frame]) | changes
        raw = {key: value for key, value in raw.items() if value is not None}
        self.line("frames.jsonl", frame, json.dumps(raw))

    def line(self, file: str, index: int, text: str) -> None:
        """Replace one line of a text file."""
        lines = (self.path / file).read_text().splitlines()
        lines[index] = text
        self.content(file, "\n".join(lines) + "\n")

    def append(self, file: str, data: bytes) -> None:
        """Append bytes to a file."""
        with (self.path / file).open("ab") as stream:
            stream.write(data)

    @staticmethod
    def png(pixels: np.ndarray) -> bytes:
        return bytes(cv2.imencode(".png", pixels)[1].tobytes())


@pytest.fixture(scope="session")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> SmallDataset:
    """Shared by all tests: leave it as it is."""
    return SmallDataset.write(tmp_path_factory.mktemp("pristine") / "small")


@pytest.fixture
def small(pristine: SmallDataset, tmp_path: Path) -> SmallDataset:
    """A copy to spoil."""
    shutil.copytree(pristine.path, tmp_path / "small")
    return SmallDataset(tmp_path / "small")
