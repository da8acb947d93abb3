"""A scene as it is rendered: the compiled model, and what rays meet at a pose of its joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim.engine import mujoco
from sim.rendering.raycast import RayScene
from sim.rendering.shading import Finish, Painter
from sim.scenes import Scene

if TYPE_CHECKING:
    from sim.rendering.gl import GlRenderer

Array = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """A model at one pose of its joints."""

    data: mujoco.MjData
    rays: RayScene
    painter: Painter


class World:
    """A compiled scene. What is rendered is the text that is stored, rounded digits and all."""

    def __init__(self, xml: str, assets: Mapping[str, bytes]) -> None:
        """Compile the scene's MJCF text, whose files are in `assets`."""
        self.xml, self.assets = xml, dict(assets)
        self.model = mujoco.MjModel.from_xml_string(xml, self.assets)
        self.finish = Finish.of_model(self.model)
        self._view: tuple[bytes, View] | None = None

    @classmethod
    def build(cls, entry: Scene, seed: int, settled: bool = False) -> World:
        """The scene of a registry's entry."""
        spec = entry.build(seed, settled)
        return cls(spec.to_xml(), dict(spec.assets))

    def at(self, qpos: Array | None = None) -> View:
        """The scene with its joints at `qpos` (nq,); None: as the model has them."""
        qpos = self.model.qpos0 if qpos is None else np.asarray(qpos, float)
        if self._view is None or self._view[0] != qpos.tobytes():
            data = mujoco.MjData(self.model)
            data.qpos[:] = qpos
            mujoco.mj_kinematics(self.model, data)
            if self._view is None:
                rays = RayScene.of_model(self.model, data)
                painter = Painter(rays, self.model)
            else:  # the shapes stay, only their places change
                rays = self._view[1].rays.at(data)
                painter = self._view[1].painter.at(rays)
            self._view = qpos.tobytes(), View(data, rays, painter)
        return self._view[1]

    @cached_property
    def gl(self) -> GlRenderer:
        """MuJoCo's own renderer, to compare with; MissingPackage where there is no OpenGL."""
        from sim.rendering.gl import GlRenderer

        return GlRenderer(self.model)
