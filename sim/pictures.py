"""Pictures of scenes: the whole with its camera poses, and one frame in colour and depth.

`python -m sim.pictures FOLDER` draws those of the documentation.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera
from depthba.se3 import inverse
from sim.capture import Capture
from sim.generation import draw_stages
from sim.options import GenerateOptions
from sim.rigs.dome import extent, look
from sim.scenes import SCENES, find_scene

Array = NDArray[np.float64]

_SIZE = (1280, 800)
_FRUSTUM = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], float)
_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 0), (4, 1), (4, 2), (4, 3))


def overview(capture: Capture) -> tuple[NDArray[np.uint8], Camera, Array]:
    """The scene from outside, at the first frame: image, camera and its T_world_camera."""
    world, track = capture.world, capture.track
    view = world.at(None if track.qpos is None else track.qpos[0])
    low, high = extent(world.model, view.data)
    places = track.T_world_camera_true[:, :3, 3]
    low, high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    towards = np.array([0.62, 0.85, 0.62]) / np.linalg.norm([0.62, 0.85, 0.62])
    camera = Camera(*_SIZE, 1250.0, 1250.0, 0.5 * (_SIZE[0] - 1), 0.5 * (_SIZE[1] - 1))
    T = look(centre + 2.2 * radius * towards, centre - [0.0, 0.0, 0.12 * radius])
    return view.painter.paint(camera, T, view.rays.view(camera, T)), camera, T


def draw_scene(scene: str, path: str | Path, seed: int = 0, frame: int | None = None) -> Path:
    """Draw a scene as a PNG: overview with the frames' places, RGB and depth of the middle frame.

    `frame` is another than the middle one. Returns the path.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    capture = Capture.plan(find_scene(scene), GenerateOptions(seed=seed))
    frame = len(capture) // 2 if frame is None else frame
    taken = capture.expose(frame)
    image, camera, T = overview(capture)
    figure = plt.figure(figsize=(14.0, 6.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=[1.7, 1.0])
    axes = [figure.add_subplot(cell) for cell in (grid[:, 0], grid[0, 1], grid[1, 1])]
    axes[0].imshow(image)
    _draw_frusta(axes[0], capture, camera, T, frame)
    axes[0].set_title(f"{scene}, seed {seed}: the scene and its {len(capture)} frames")
    assert taken.rgb is not None
    axes[1].imshow(taken.rgb)
    axes[1].set_title(f"frame {frame}: colour")
    shown = axes[2].imshow(taken.depth, cmap="turbo", interpolation="nearest")
    axes[2].set_title(f"frame {frame}: depth, {capture.sensor.model} (white: none)")
    figure.colorbar(shown, ax=axes[2], label="m", shrink=0.9)
    for axis in axes:
        axis.set_xticks([])
        axis.set_yticks([])
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)
    return Path(path)


def _draw_frusta(axis, capture: Capture, camera: Camera, T_world_view: Array, frame: int) -> None:
    own, poses = capture.sensor.camera, capture.track.T_world_camera_true
    length = 0.12 * float(np.nanmedian(capture.expose(frame, rgb=False).exact))
    reach = [0.5 * own.width / own.fx, 0.5 * own.height / own.fy, 1.0]
    corners = np.vstack([_FRUSTUM * reach * length, np.zeros(3)])
    T_view_world = inverse(T_world_view)
    for k, T in enumerate(poses):
        T_view_camera = T_view_world @ T
        points = camera.project(corners @ T_view_camera[:3, :3].T + T_view_camera[:3, 3])
        for a, b in _EDGES:
            axis.plot(
                *points[[a, b]].T,
                color="orangered" if k == frame else "deepskyblue",
                linewidth=1.6 if k == frame else 0.9,
            )
    axis.set_xlim(-0.5, camera.width - 0.5)
    axis.set_ylim(camera.height - 0.5, -0.5)


def draw_all(folder: Path) -> None:
    """The documentation's pictures: each scene, and each sensor's noise stage by stage."""
    folder.mkdir(parents=True, exist_ok=True)
    for scene in SCENES:
        print(draw_scene(scene, folder / f"{scene}.png"))
    for sensor, scene in (("zed2", "lab-1"), ("sp1000", "industrial-6")):
        print(draw_stages(scene, folder / f"noise-{sensor}.png", GenerateOptions()))


if __name__ == "__main__":
    draw_all(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/scenes"))
