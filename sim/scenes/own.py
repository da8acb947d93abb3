"""Scenes of one's own that are MJCF files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim.engine import mujoco
from sim.errors import SimulationError


@dataclass(frozen=True)
class MjcfFile:
    """A builder that reads an MJCF model; the arrangement is the file's, whatever the seed."""

    path: Path

    def __call__(self, seed: int) -> mujoco.MjSpec:
        """The model with all its meshes and textures taken in as assets."""
        try:
            spec = mujoco.MjSpec.from_file(str(self.path))
        except ValueError as error:
            raise SimulationError(
                f"scene {self.path}: {_one_line(error)}; expected an MJCF model"
            ) from error
        _take_in(spec.meshes, self.path.parent / (spec.meshdir or ""), spec)
        _take_in(spec.hfields, self.path.parent / (spec.meshdir or ""), spec)
        _take_in(spec.textures, self.path.parent / (spec.texturedir or ""), spec)
        spec.meshdir = spec.texturedir = ""
        return spec


def _take_in(users: Iterable[Any], folder: Path, spec: mujoco.MjSpec) -> None:
    for user in users:
        if not user.file:
            continue
        source = folder / user.file
        name = f"{user.name or Path(user.file).stem}{source.suffix}"
        try:
            data = source.read_bytes()
        except OSError as error:
            raise SimulationError(
                f"scene {spec.modelname}: {source}: {error.strerror}, expected the file that the"
                " model names"
            ) from error
        if spec.assets.get(name, data) != data:
            name = f"{len(spec.assets)}-{name}"
        spec.assets[name] = data
        # Without a name of its own an asset is called after its file.
        user.name = user.name or Path(user.file).stem
        user.file = name


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
