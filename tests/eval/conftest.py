"""An analytic surface seen by a few cameras, and a run of it made by hand: no optimiser needed."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from depthba import se3
from depthba.clouds import load_clouds, transform
from depthba.dataset import Dataset, DatasetWriter
from depthba.depth_map import DepthMap
from depthba.options import Options
from depthba.result import FrameReport, Iteration, Result, WeakDirection
from depthba.run_folder import RunFolder

Floats = NDArray[np.float64]

FRAMES = 6
WIDTH, HEIGHT, FOCAL = 80, 60, 80.0


def surface(x: Floats, y: Floats) -> Floats:
    """Gentle waves, metres."""
    return 0.03 * np.sin(4.0 * x) * np.cos(5.0 * y) + 0.02 * np.sin(9.0 * x + 3.0 * y)


def cameras(count: int) -> Floats:
    """Cameras 1 m above the ground that look down, side by side; (count, 4, 4)."""
    T = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (count, 1, 1))
    T[:, 0, 3] = 0.2 * np.arange(count)
    T[:, 2, 3] = 1.0
    return T


def render(T: Floats) -> Floats:
    """Depth image of the surface, metres, exact to rounding."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - 39.5) / FOCAL, (v - 29.5) / FOCAL, np.ones(u.shape)], axis=-1)
    rays = rays @ T[:3, :3].T
    depth = np.full(u.shape, 1.0)
    for _ in range(60):  # the surface is flat enough for the fixed point to attract
        p = T[:3, 3] + depth[..., None] * rays
        depth = (surface(p[..., 0], p[..., 1]) - T[2, 3]) / rays[..., 2]
    return depth


def write_scene(path: Path, frames: int, truth: bool = True, rgb: bool = False) -> Dataset:
    """Write the surface as a dataset whose measured poses are off by centimetres."""
    sensor = {
        "kind": "depth",
        "model": "analytic",
        "width": WIDTH,
        "height": HEIGHT,
        "fx": FOCAL,
        "fy": FOCAL,
        "cx": 39.5,
        "cy": 29.5,
        "distortion": [0, 0, 0, 0, 0],
        "depth_scale": 2e-5,
    }
    writer = DatasetWriter.create(
        path, {"name": "waves", "sensor": sensor, "map_frame": "world", "seed": 5}
    )
    rng = np.random.default_rng(1)
    T_true = cameras(frames)
    off = rng.normal(size=(frames, 6)) * ([0.01] * 3 + [0.005] * 3)
    off[0] = 0.0
    T_measured = se3.retract(T_true, off)
    for i in range(frames):
        colour = np.full((HEIGHT, WIDTH, 3), 40 * (i % 6), np.uint8) if rgb else None
        writer.add_frame(
            stamp=float(i),
            depth=render(T_true[i]),
            rgb=colour,
            T_world_camera=T_measured[i],
            T_world_camera_true=T_true[i] if truth else None,
        )
    return Dataset.open(path)


def binned_map(dataset: Dataset, T: Floats, spacing: float = 0.02) -> DepthMap:
    """Mean height per node, on a grid that does not depend on the poses."""
    clouds = load_clouds(dataset)
    p = np.concatenate([transform(t, c.points) for t, c in zip(T, clouds, strict=True)])
    nx, ny = int((0.2 * len(dataset) + 1.0) / spacing), int(1.0 / spacing)
    k = np.rint((p[:, :2] - [-0.6, -0.5]) / spacing).astype(int)
    ok = (k >= 0).all(axis=1) & (k < [nx, ny]).all(axis=1)
    node = k[ok, 1] * nx + k[ok, 0]
    count = np.bincount(node, minlength=nx * ny).reshape(ny, nx)
    total = np.bincount(node, p[ok, 2], minlength=nx * ny).reshape(ny, nx)
    heights = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    sigma = np.where(count > 0, 1e-3, np.nan)
    return DepthMap(heights, (-0.6, -0.5), spacing, np.eye(4), count.astype(np.int64), sigma)


def iterations(dataset: Dataset, T_end: Floats, count: int) -> Iterator[Iteration]:
    """Go from the measured poses to ``T_end``, over two levels."""
    T_start = dataset.T_world_camera_measured
    left = se3.difference(T_start, T_end)
    for k in range(count):
        share = 0.5 ** (k + 1)
        T = se3.retract(T_end, share * left)
        level = int(k >= count // 2)
        yield Iteration(
            index=k,
            level=level,
            levels=2,
            spacing=0.04 / (1 + level),
            phase="quadratic",
            cost=1.0 + share,
            step_t=float(np.abs(share * left[:, :3]).max()),
            step_r=float(np.abs(share * left[:, 3:]).max()),
            damping=1e-4,
            accepted=True,
            inliers=0.9,
            sigma=1e-3 + share * 1e-2,
            cells=1000,
            seconds=0.1 * k,
            T_world_camera=T,
            depth_map=binned_map(dataset, T, 0.04 / (1 + level)),
        )


def made_result(dataset: Dataset, T_end: Floats, steps: int = 4) -> Result:
    """A result that ends at ``T_end``."""
    n = len(dataset)
    T_start = dataset.T_world_camera_measured
    moved = se3.difference(T_end, T_start)
    variances = np.tile([1e-8] * 3 + [1e-10] * 3, n)
    variances[:6] = 0.0
    weak = WeakDirection(2, "yaw", np.eye(6)[5], 0.4, 0.05, 0.002)
    return Result(
        status="weak",
        reason="the data leave frame 2 open along yaw",
        frame_ids=tuple(f.id for f in dataset),
        stamps=tuple(float(s) for s in dataset.stamps),
        T_world_camera=T_end,
        T_world_camera_start=T_start,
        depth_map=binned_map(dataset, T_end),
        depth_map_start=binned_map(dataset, T_start),
        covariance=np.diag(variances),
        sigma=1e-3,
        inflation=2.0,
        history=tuple(iterations(dataset, T_end, steps)),
        weak=(weak,),
        frames=tuple(
            FrameReport(
                frame=f.id,
                points=WIDTH * HEIGHT,
                overlap=0.8,
                inliers=0.9,
                move_t=float(np.linalg.norm(m[:3])),
                move_r=float(np.linalg.norm(m[3:])),
                held="too little overlap" if f.id == 3 else "",
            )
            for f, m in zip(dataset, moved, strict=True)
        ),
        seconds={"read": 0.1, "solve": 0.4, "total": 0.5},
        overlap=np.full((n, n), 0.5),
    )


def listeners(port: int) -> list[str]:
    """Where this machine listens on a port: addresses as the kernel writes them."""
    rows = [
        row.split()
        for table in ("tcp", "tcp6")
        for row in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
    ]
    return [r[1] for r in rows if r[3] == "0A" and r[1].endswith(f":{port:04X}")]


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The surface, with truth."""
    return write_scene(tmp_path_factory.mktemp("scene") / "waves", FRAMES)


@pytest.fixture(scope="session")
def near_truth(dataset: Dataset) -> Floats:
    """Poses a tenth of a millimetre and ten microradians from the truth, frame 0 exact."""
    assert dataset.T_world_camera_true is not None
    rng = np.random.default_rng(2)
    off = rng.normal(size=(FRAMES, 6)) * ([1e-4] * 3 + [1e-5] * 3)
    off[0] = 0.0
    return se3.retract(dataset.T_world_camera_true, off)


@pytest.fixture(scope="session")
def result(dataset: Dataset, near_truth: Floats) -> Result:
    """A run's result, made by hand."""
    return made_result(dataset, near_truth)


@pytest.fixture(scope="session")
def written_run(tmp_path_factory: pytest.TempPathFactory, dataset: Dataset, result: Result) -> Path:
    """A run folder, not to be changed."""
    folder = RunFolder.create(tmp_path_factory.mktemp("runs") / "waves")
    folder.write(result, Options(), dataset)
    return folder.path


@pytest.fixture
def run(written_run: Path, tmp_path: Path) -> Path:
    """A run folder of the test's own."""
    return Path(shutil.copytree(written_run, tmp_path / "run"))
