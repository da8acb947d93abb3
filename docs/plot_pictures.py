"""Draws the pictures of docs/plots.md: `make screenshots` calls it. Takes a minute.

A bumpy floor is captured twice, with a heap more and a pit more the second time, registered, and
plotted.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.cli import main as depthba
from depthba.dataset import DatasetWriter

Floats = NDArray[np.float64]
DOCS = Path(__file__).parent
WIDTH, HEIGHT, FOCAL = 200, 150, 200.0
FRAMES, NOISE, OFF_T, OFF_R = 12, 0.001, 0.01, 0.008


def floor(x: Floats, y: Floats, changed: bool) -> Floats:
    """Return the heights of the floor, m."""
    z = 0.02 * np.sin(11 * x) * np.cos(9 * y) + 0.012 * np.sin(6 * x + 10 * y)
    z = z + 0.004 * np.sin(41 * x + 13 * y) * np.sin(37 * y - 11 * x)
    if changed:
        z = z + 0.05 * np.exp(-((((x - 0.9) / 0.12) ** 2 + ((y - 0.15) / 0.09) ** 2) ** 2))
        z = z - 0.03 * np.exp(-((((x - 0.3) / 0.10) ** 2 + ((y + 0.25) / 0.13) ** 2) ** 2))
    return np.asarray(z)


def captured(path: Path, changed: bool, seed: int) -> None:
    """Write a dataset of the floor: two rows of views from a metre above."""
    rng = np.random.default_rng(seed)
    lens = {"fx": FOCAL, "fy": FOCAL, "cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2}
    sensor = {"kind": "depth", "model": "made up", "width": WIDTH, "height": HEIGHT, **lens}
    sensor |= {"distortion": [0, 0, 0, 0, 0], "depth_scale": 5e-5}
    sensor |= {"noise": {"sigma_m": NOISE, "at_m": 1.0, "power": 0}}
    believed = {"sigma_t_m": [OFF_T] * 3, "sigma_r_rad": [OFF_R] * 3}
    header = {"format": "depthba-dataset", "version": 1, "name": "floor", "map_frame": "world"}
    writer = DatasetWriter.create(path, {**header, "sensor": sensor, "pose_noise": believed})
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - lens["cx"]) / FOCAL, (v - lens["cy"]) / FOCAL, np.ones(u.shape)], axis=-1)
    for k in range(FRAMES):
        row, column = divmod(k, FRAMES // 2)
        across = column if row == 0 else FRAMES // 2 - 1 - column
        R = se3.exp_so3(rng.uniform(-0.1, 0.1, 3)) @ np.diag([1.0, -1.0, -1.0])
        t = np.array([0.25 * across, 0.35 * row - 0.25, rng.uniform(0.95, 1.05)])
        directions = rays @ R.T
        z = -t[2] / directions[..., 2]
        for _ in range(60):
            p = t + z[..., None] * directions
            z = z - 0.9 * (p[..., 2] - floor(p[..., 0], p[..., 1], changed)) / directions[..., 2]
        true = se3.make(R, t)
        error = np.concatenate([rng.normal(0, OFF_T, 3), rng.normal(0, OFF_R, 3)])
        measured = se3.retract(true, error if k else np.zeros(6))
        writer.add_frame(
            stamp=float(k),
            depth=z + rng.normal(0, NOISE, z.shape),
            T_world_camera=measured,
            T_world_camera_true=true,
        )


def main() -> None:
    """Draw all pictures."""
    with tempfile.TemporaryDirectory(prefix="depthba-") as name:
        folder = Path(name)
        for changed, run in ((False, "monday"), (True, "tuesday")):
            captured(folder / f"{run}-data", changed, seed=int(changed))
            depthba(["register", str(folder / f"{run}-data"), "--out", str(folder / run)])
        out = str(DOCS / "plots")
        depthba(["plot", str(folder / "monday"), "--out", out])
        against = ["--against", str(folder / "monday")]
        depthba(["plot", str(folder / "tuesday"), *against, "--out", out, "--json"])


if __name__ == "__main__":
    main()
