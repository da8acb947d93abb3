"""From how far off the registration succeeds: plain, with the pairwise start, and the peer.

    python -m tests.benchmarks.basin --starts 20 --save basin.jsonl --plot docs/basin.png

The true poses are disturbed anew for every start (Gaussian per axis, frame 0 exact); the magnitude
is told to the registration as the measured poses' standard deviation. A run succeeds when its mean
absolute errors per axis, translation and rotation, are under twice the median of the good ones of
its method and dataset: those within three times the smallest. The peer is GICP on all overlapping
pairs and a pose graph, in two rounds with a shrinking reach.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import depthba
from depthba import se3
from depthba.dataset import Dataset
from depthba.optimiser.problem import point_spacing
from depthba.options import Options
from depthba.pairwise import graph, refine

Floats = NDArray[np.float64]

SHARED = Path(__file__).parents[3] / "shared"
# Map spacing, m: coarser than the registration would choose, which changes the error that it ends
# with but not whether it gets there.
RESOLUTIONS = {"rock-field": 0.05, "bumpy-a": 0.01}
# Start errors per axis, m and rad.
MAGNITUDES = ((0.01, 0.02), (0.03, 0.02), (0.05, 0.03), (0.1, 0.05), (0.2, 0.1))
METHODS = ("plain", "pairwise", "peer")
NAMES = {
    "plain": "depthba", "pairwise": "depthba --init pairwise", "peer": "GICP pairs + pose graph",
}  # fmt: skip
COLOURS = {"plain": "tab:blue", "pairwise": "tab:green", "peer": "tab:red"}


@dataclass(frozen=True)
class Run:
    """One start of one method."""

    dataset: str
    method: str
    off: tuple[float, float]
    """Standard deviation of the start per axis, m and rad."""
    start: int
    error: tuple[float, float]
    """Mean absolute error per axis at the end, m and rad."""
    seconds: float


def disturbed(dataset: Dataset, off: tuple[float, float], start: int) -> Dataset:
    """Return the dataset with measured poses that are off by that much."""
    truth = dataset.T_world_camera_true
    assert truth is not None
    rng = np.random.default_rng(start)
    error = rng.standard_normal((len(truth), 6)) * np.repeat(off, 3)
    error[0] = 0.0
    poses = se3.retract(truth, error)
    frames = tuple(replace(f, T_world_camera=T) for f, T in zip(dataset.frames, poses, strict=True))
    return replace(dataset, frames=frames)


def run(dataset: Dataset, method: str, off: tuple[float, float], start: int) -> Run:
    """Register from one start."""
    given, truth = disturbed(dataset, off, start), dataset.T_world_camera_true
    assert truth is not None
    began = time.perf_counter()
    if method == "peer":
        T = peer(given)
    else:
        options = Options(
            init="measured" if method == "plain" else "pairwise",
            resolution=RESOLUTIONS[dataset.name],
            prior_t=off[0], prior_r=off[1], threads=1,
        )  # fmt: skip
        T = depthba.register(given, options).T_world_camera
    seconds = time.perf_counter() - began
    e = np.abs(se3.difference(se3.align_first(T, truth), truth)[1:])
    error = float(e[:, :3].mean()), float(e[:, 3:].mean())
    return Run(dataset.name, method, off, start, error, seconds)


def peer(dataset: Dataset) -> Floats:
    """GICP on pairs that overlap at the start by 15 %, voxels of 4 times the points' spacing."""
    import small_gicp

    clouds = [frame.points() for frame in dataset]
    spacing = point_spacing(dataset.sensor, clouds)
    T = dataset.T_world_camera_measured
    cells = []
    for cloud, pose in zip(clouds, T, strict=True):
        xy = cloud @ pose[:2, :3].T + pose[:2, 3]
        cells.append(np.unique(np.floor(xy / (6 * spacing)).astype(np.int64) @ [2**31, 1]))
    pairs = [
        (i, j)
        for i in range(len(T)) for j in range(i + 1, len(T))
        if len(np.intersect1d(cells[i], cells[j])) >= 0.15 * min(len(cells[i]), len(cells[j]))
    ]  # fmt: skip
    thinned = [refine.prepare(cloud, 4 * spacing) for cloud in clouds]
    hardly = np.repeat(1e-6 * np.eye(6)[None], len(T), axis=0)
    for reach in (25 * spacing, 10 * spacing):
        edges = []
        for i, j in pairs:
            found = small_gicp.align(
                thinned[i][0], thinned[j][0], thinned[i][1], se3.inverse(T[i]) @ T[j],
                registration_type="GICP", max_correspondence_distance=reach, max_iterations=50,
            )  # fmt: skip
            at = clouds[j].mean(axis=0, dtype=float)
            lever = float(np.sqrt(np.square(clouds[j] - at).sum(axis=1).mean()))
            if found.converged and found.num_inliers >= 100:
                edges.append(graph.Edge(i, j, np.asarray(found.T_target_source), at, lever))
        T = graph.solve(T, edges, 100.0, hardly).T_map_camera
    return T


def study(
    starts: int, methods: tuple[str, ...] = METHODS, save: Path | None = None
) -> Iterator[Run]:
    """Yield all runs; those that the file ``save`` holds are not repeated, new ones go there."""
    done = {}
    if save and save.is_file():
        for line in save.read_text().splitlines():
            entry = json.loads(line)
            entry |= {"off": tuple(entry["off"]), "error": tuple(entry["error"])}
            known = Run(**entry)
            done[known.dataset, known.method, known.off, known.start] = known
    for name in RESOLUTIONS:
        if not (SHARED / "data" / name).is_dir():
            continue
        dataset = Dataset.open(SHARED / "data" / name)
        for off in MAGNITUDES:
            for method in methods:
                for start in range(starts):
                    found = done.get((name, method, off, start))
                    if found is None:
                        found = run(dataset, method, off, start)
                        if save:
                            with save.open("a") as file:
                                file.write(json.dumps(asdict(found)) + "\n")
                    yield found


def successes(runs: list[Run]) -> list[bool]:
    """Tell which runs succeeded."""
    limits = {}
    for key in {(r.dataset, r.method) for r in runs}:
        errors = np.array([r.error for r in runs if (r.dataset, r.method) == key])
        good = errors[(errors < 3 * errors.min(axis=0)).all(axis=1)]
        limits[key] = 2 * np.median(good if len(good) else errors[:1], axis=0)
    return [bool((np.array(r.error) < limits[r.dataset, r.method]).all()) for r in runs]


def rows(runs: list[Run]) -> list[tuple[str, str, tuple[float, float], int, int, float, float]]:
    """Return dataset, method, magnitude, successes, starts, median error (m) and seconds."""
    fine = successes(runs)
    out = []
    for key in dict.fromkeys((r.dataset, r.method, r.off) for r in runs):
        mine = [k for k, r in enumerate(runs) if (r.dataset, r.method, r.off) == key]
        error = float(np.median([runs[k].error[0] for k in mine]))
        seconds = float(np.median([runs[k].seconds for k in mine]))
        out.append((*key, sum(fine[k] for k in mine), len(mine), error, seconds))
    return out


def table(runs: list[Run]) -> str:
    """Return the table that the study prints."""
    lines = [
        f"{'':11} {'':24} {'start off by':>16} {'succeed':>8} {'median error':>13} {'time':>7}"
    ]
    for name, method, off, good, count, error, seconds in rows(runs):
        lines.append(
            f"{name:11} {NAMES[method]:24} {1e3 * off[0]:4.0f} mm {1e3 * off[1]:3.0f} mrad "
            f"{good:4d}/{count:<3d} {1e3 * error:10.3f} mm {seconds:5.1f} s"
        )
    return "\n".join(lines)


def plot(runs: list[Run], path: Path) -> None:
    """Draw the share of starts that succeed against how far off they are."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    names = list(dict.fromkeys(r.dataset for r in runs))
    figure = Figure(figsize=(5.2 * len(names), 4.0), layout="constrained")
    axes = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    found = rows(runs)
    for axis, name in zip(axes, names, strict=True):
        for k, method in enumerate(METHODS):
            for _, _, off, good, count, *_ in (r for r in found if r[:2] == (name, method)):
                at, share = MAGNITUDES.index(off) + 0.28 * (k - 1), 100 * good / count
                axis.bar(at, max(share, 0.6), 0.26, color=COLOURS[method])
                axis.text(at, share + 2, f"{good}/{count}", ha="center", fontsize=7)
        ticks = [f"{1e3 * t:.0f} mm\n{1e3 * r:.0f} mrad" for t, r in MAGNITUDES]
        axis.set_xticks(range(len(MAGNITUDES)), ticks)
        axis.set_title(name)
        axis.set_xlabel("start poses off by (standard deviation per axis)")
        axis.set_ylim(0, 110)
    axes[0].set_ylabel("starts that succeed, %")
    handles = [Patch(color=COLOURS[m], label=NAMES[m]) for m in METHODS]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(METHODS))
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--save", type=Path)
    parser.add_argument("--plot", type=Path)
    given = parser.parse_args()
    runs = list(study(given.starts, tuple(given.methods), given.save))
    print(table(runs))
    if given.plot:
        plot(runs, given.plot)


if __name__ == "__main__":
    main()
