"""What the pages take for granted: datasets, runs, folders of images; small and quick."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from depthba import se3
from depthba.cli import main
from depthba.dataset import DatasetWriter
from tests.depthba.analytic_scene import bumpy, cameras, write_scene

RUNS = {"my-run": "my-dataset", "other-run": "other-dataset"}
TUM = "rgbd_dataset_freiburg1_desk"
WIDTH, HEIGHT, FOCAL = 640, 480, 525.0
FRAMES = 11
"""Of the wide images: every tenth leaves two."""


def small(folder: Path) -> Path:
    """Write two small datasets and their runs; return the folder."""
    for seed, (run, data) in enumerate(RUNS.items()):
        write_scene(folder / data, frames=5, seed=seed)
        status = main(["register", str(folder / data), "--out", str(folder / run)])
        assert status == 0, f"{data}: status {status}"
    shutil.copy(folder / "my-dataset" / "poses_true.txt", folder / "true.txt")
    return folder


def laid_out(stage: Path, folder: Path, without: Sequence[str] = ()) -> None:
    """Copy what a reader has into a folder; a copied run is of the dataset beside it."""
    for item in stage.iterdir():
        if item.name not in without:
            (shutil.copytree if item.is_dir() else shutil.copy)(item, folder / item.name)
    for run, data in RUNS.items():
        file = folder / run / "result.json"
        if file.exists():
            told = json.loads(file.read_text())
            told["dataset"]["path"] = str(folder / data)
            file.write_text(json.dumps(told))


def wide(folder: Path) -> Path:
    """Write my-pngs, images of 640 x 480 in mm beside a TUM file, and a TUM RGB-D sequence.

    Returns the folder.
    """
    lens = {"fx": FOCAL, "fy": FOCAL, "cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2}
    sensor = {"kind": "depth", "model": "", "width": WIDTH, "height": HEIGHT, **lens}
    sensor |= {"distortion": [0, 0, 0, 0, 0], "depth_scale": 0.001}
    header = {"format": "depthba-dataset", "version": 1, "name": "wide", "sensor": sensor}
    writer = DatasetWriter.create(folder / "wide", header)
    rng = np.random.default_rng(0)
    for k, T in enumerate(cameras(FRAMES, rng)):
        T[0, 3] *= 0.3
        off = np.concatenate([rng.normal(0, 0.004, 3), rng.normal(0, 0.004, 3)])
        writer.add_frame(stamp=float(k), depth=_depth(T, lens), T_world_camera=se3.retract(T, off))
    status = main(["convert", str(folder / "wide"), str(folder / TUM), "--to", "tum-rgbd"])
    assert status == 0, f"{TUM}: status {status}"
    bare = folder / "my-pngs"
    bare.mkdir()
    (bare / "depth").mkdir()
    for k in range(3):
        name = f"depth/{k:06d}.png"
        shutil.copy(folder / "wide" / name, bare / name)
    lines = (folder / "wide" / "poses_measured.txt").read_text().splitlines()
    poses = [line for line in lines if not line.startswith("#")]
    (bare / "poses.txt").write_text("\n".join(poses[:3]) + "\n")
    return folder


def _depth(T: np.ndarray, lens: dict[str, float]) -> np.ndarray:
    """Return the depth image of the bumpy field, m."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    x, y = (u - lens["cx"]) / lens["fx"], (v - lens["cy"]) / lens["fy"]
    rays = np.stack([x, y, np.ones(u.shape)], axis=-1) @ T[:3, :3].T
    z = -T[2, 3] / rays[..., 2]
    step = np.array(np.inf)
    while np.abs(step).max() > 1e-6:  # a thousandth of a step of the images
        p = T[:3, 3] + z[..., None] * rays
        height, along_x, along_y = bumpy(p[..., 0], p[..., 1])
        slope = rays[..., 2] - along_x * rays[..., 0] - along_y * rays[..., 1]
        step = (p[..., 2] - height) / slope
        z = z - step
    return np.asarray(z)
