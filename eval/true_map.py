"""The true height map of a simulated dataset: rays cast down upon the scene that it was made of."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba.clouds import transform
from depthba.dataset import Dataset
from depthba.errors import DatasetError
from sim import stored_scene

Floats = NDArray[np.float64]

NEEDED = ("mujoco", "embreex")
"""Packages that read it; without them there is no true map."""


class TrueSurface:
    """The scene that a dataset was rendered from, without what has joints: a robot's arm."""

    def __init__(self, path: Path) -> None:
        """Read the scene in the dataset folder ``path``: what `depthba generate` rendered.

        `MissingPackage` without the simulator; `DatasetError` where the scene names what is not
        the dataset's, or is none.
        """
        from sim.engine import mujoco  # takes a second, and few datasets need it
        from sim.rendering.raycast import RayScene
        from sim.rendering.tessellate import Shapes, Triangles

        xml, files = stored_scene.read(path)
        try:
            model = mujoco.MjModel.from_xml_string(xml, files)
        except ValueError as error:
            line = " ".join(str(error).split())
            raise DatasetError(
                f"{path / stored_scene.SCENE}: {line}, expected an MJCF model"
            ) from (error)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        soup = Shapes(model).at(data)
        stays = model.body_weldid[model.geom_bodyid[soup.geom]] == 0
        faces = soup.faces[stays]
        self._rays = RayScene(Triangles(soup.vertices, faces, soup.geom[stays]))
        self._corners = soup.vertices[faces.ravel()]

    @classmethod
    def of(cls, dataset: Dataset) -> TrueSurface | None:
        """Return the true surface of a dataset; None where it or a package is not there."""
        if not (dataset.path / stored_scene.SCENE).is_file() or not all(
            map(importlib.util.find_spec, NEEDED)
        ):
            return None
        return cls(dataset.path)

    def heights(
        self,
        T_true_map: Floats,
        origin: tuple[float, float],
        spacing: float,
        shape: tuple[int, int],
    ) -> Floats:
        """Return the highest point over each node, (ny, nx), m along the map's z axis, or NaN.

        Args:
            T_true_map: (4, 4), map coordinates into those of the true world.
            origin: map x and y of node [0, 0], m.
            spacing: of the nodes, m.
            shape: (ny, nx).

        """
        R, t = T_true_map[:3, :3], T_true_map[:3, 3]
        top = float(np.max((self._corners - t) @ R[:, 2], initial=0.0)) + 1.0
        ny, nx = shape
        x, y = np.meshgrid(origin[0] + spacing * np.arange(nx), origin[1] + spacing * np.arange(ny))
        above = np.stack([x.ravel(), y.ravel(), np.full(x.size, top)], axis=1)
        down = np.broadcast_to(-R[:, 2], above.shape)
        hits = self._rays.cast(transform(T_true_map, above), down)
        return np.asarray(top - hits.distance.reshape(shape))
