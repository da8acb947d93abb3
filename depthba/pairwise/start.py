"""Start poses from pairs of frames, for measured poses too far off to start from."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.dataset import Dataset
from depthba.pairwise import correlate, graph, refine
from depthba.pairwise.raster import Lattice, lattice_for, rasterise, relief
from depthba.pairwise.search import Candidate, Doubt, View, middle, search, shared, view_of

Floats = NDArray[np.float64]
A = TypeVar("A")
B = TypeVar("B")

# The search allows for start poses at least this far off (standard deviation per axis): who asks
# for it doubts what the dataset states.
LEAST_T, LEAST_R = 0.1, 0.05
# Share of the smaller frame that two frames must have in common to be compared.
OVERLAP = 0.2
# Partners a frame is compared with, however little of it they share.
PARTNERS = 3
# Evidence above which a place found by correlation may enter the graph, and above which a pair that
# GICP refined may; correlation of the latter.
PLAUSIBLE, SURE, ALIKE = 10.0, 15.0, 0.6
# What pairs may disagree by in the graph, in cells: as correlation finds them, and refined.
COARSE, FINE = 3.0, 0.5
# Size of GICP's voxels, and how far a point's counterpart may be in each of its rounds, in cells.
VOXEL, REACHES = 1.0, (3.0, 1.0)


@dataclass(frozen=True)
class Pair:
    """Two frames that were compared."""

    i: int
    j: int
    fitness: float
    """Correlation of the two reliefs, laid on each other as the pair says: at most 1."""
    inliers: int
    """Points of j (thinned) that lie on frame i."""
    fault: str
    """Why it was not used; empty where it was."""

    @property
    def used(self) -> bool:
        """Whether it holds the two frames together in the result."""
        return not self.fault


@dataclass(frozen=True, eq=False)
class PairwiseStart:
    """Start poses, and what they rest on."""

    T_world_camera: Floats
    """(N, 4, 4)."""
    pairs: tuple[Pair, ...]
    left: tuple[int, ...]
    """Indices of frames left where they were, as no pair could be trusted. Never the first."""


def pairwise_poses(
    clouds: list[NDArray[np.float32]],
    T_world_camera: Floats,
    sigma_t: Floats,
    sigma_r: Floats,
    spacing: float,
    threads: int | None = None,
) -> PairwiseStart:
    """Bring frames whose poses are roughly known into the reach of the optimiser.

    Each frame's height map over the plane that the sensors look at is searched for in those of its
    neighbours, over all shifts and turns that the start poses allow. A pose graph over what was
    found drops what contradicts its cycles; all frames that now overlap are refined by GICP, and
    the graph is solved again.

    Args:
        clouds: (n, 3) each, sensor frame, metres; n may be 0.
        T_world_camera: (N, 4, 4), the start; the first is kept.
        sigma_t: (3,) m, standard deviations of the start along the world axes. The search allows
            for at least 0.1 m.
        sigma_r: (3,) rad, likewise; at least 0.05 rad.
        spacing: distance of neighbouring points, m.
        threads: how many; None: all cores. They do not change the result.
    """
    if not any(len(c) for c in clouds):
        return PairwiseStart(T_world_camera.copy(), (), tuple(range(1, len(clouds))))
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        return _Frames(clouds, T_world_camera, sigma_t, sigma_r, spacing, pool).solve()


def dataset_poses(
    dataset: Dataset, sigma_t: Floats, sigma_r: Floats, threads: int | None = None
) -> PairwiseStart:
    """Do the same for the measured poses of a dataset; frames left where they were are logged."""
    from depthba.optimiser.problem import point_spacing

    clouds = [frame.points() for frame in dataset]
    seen = any(len(c) for c in clouds)
    spacing = point_spacing(dataset.sensor, clouds) if seen else 1.0
    measured = dataset.T_world_camera_measured
    start = pairwise_poses(clouds, measured, sigma_t, sigma_r, spacing, threads)
    for k in start.left:
        logging.getLogger(__name__).warning(
            "frame %d: no other frame matches it surely; it starts where it was measured",
            dataset[k].id,
        )
    return start


class _Frames:
    """The frames in a common map plane, with what all steps need of them."""

    def __init__(
        self,
        clouds: list[NDArray[np.float32]],
        T_world_camera: Floats,
        sigma_t: Floats,
        sigma_r: Floats,
        spacing: float,
        pool: ThreadPoolExecutor,
    ) -> None:
        self.clouds, self.pool, self.T_world_camera = clouds, pool, T_world_camera
        R = _towards(T_world_camera)
        self.T_map_world = se3.make(R, np.zeros(3))
        self.T_start = self.T_map_world @ T_world_camera
        self.V_t = R @ np.diag(np.square(np.maximum(sigma_t, LEAST_T))) @ R.T
        self.V_r = R @ np.diag(np.square(np.maximum(sigma_r, LEAST_R))) @ R.T
        placed = [_moved(p, T) for p, T in zip(clouds, self.T_start, strict=True)]
        self.lattice: Lattice = lattice_for([p - middle(p) for p in placed], spacing)

    def solve(self) -> PairwiseStart:
        """Search, agree, refine, agree."""
        lattice = self.lattice
        views = self.views(self.T_start)
        found = self.searched(views)
        T = self.T_start
        edges = [
            self.edge(c.i, c.j, se3.inverse(T[c.i]) @ c.T_map_map @ T[c.j], c.evidence)
            for c in found
            if c.evidence > PLAUSIBLE
        ]
        information = self.start_information()
        T = graph.solve(T, edges, COARSE * lattice.cell, information).T_map_camera
        thinned = self.each(lambda p: refine.prepare(p, VOXEL * lattice.cell), self.clouds)
        pairs: tuple[Pair, ...] = ()
        for reach in REACHES:
            pairs, T = self.refined(thinned, T, reach * lattice.cell, information)
        tied = {k for p in pairs if p.used for k in (p.i, p.j)}
        left = tuple(k for k in range(1, len(T)) if k not in tied)
        poses = se3.inverse(self.T_map_world) @ T
        for k in (0, *left):
            poses[k] = self.T_world_camera[k]
        return PairwiseStart(poses, pairs, left)

    def each(self, work: Callable[[A], B], items: Iterable[A]) -> list[B]:
        """Do the work for all items on all threads; results in order."""
        return list(self.pool.map(work, items))

    def views(self, T_map_camera: Floats) -> list[View]:
        """Put all frames on rasters of their own."""
        return self.each(
            lambda k: view_of(_moved(self.clouds[k], T_map_camera[k]), self.lattice),
            range(len(self.clouds)),
        )

    def overlapping(self, views: list[View]) -> list[tuple[int, int]]:
        """Return the pairs i < j worth comparing."""
        n = len(views)
        share = np.zeros((n, n))
        for i in range(n):
            for j in range(i + 1, n):
                share[i, j] = share[j, i] = shared(views[i], views[j], self.lattice)
        chosen = share >= OVERLAP
        for i in range(n):
            best = np.argsort(-share[i], kind="stable")[:PARTNERS]
            chosen[i, best[share[i, best] > 0]] = True
        return [(i, j) for i in range(n) for j in range(i + 1, n) if chosen[i, j] or chosen[j, i]]

    def searched(self, views: list[View]) -> list[Candidate]:
        """Search all pairs within the doubt about the start poses."""
        size, lattice = correlate.padded(self.lattice), self.lattice
        spectra = self.each(lambda v: correlate.spectrum(v.relief, v.raster.seen, size), views)
        doubts = []
        for k, view in enumerate(views):
            known = 1e-6 if k == 0 else 1.0
            H = se3.hat(view.centre - self.T_start[k, :3, 3])
            doubts.append(Doubt(
                known * (self.V_t + H @ self.V_r @ H.T)[:2, :2], known * float(self.V_r[2, 2])
            ))  # fmt: skip
        partners: dict[int, list[int]] = {}
        for i, j in self.overlapping(views):
            partners.setdefault(j, []).append(i)
        found = self.each(
            lambda j: search(views, spectra, doubts, j, partners[j], lattice), sorted(partners)
        )
        return [c for some in found for c in some if c]

    def refined(
        self, thinned: list[tuple[Any, Any]], T: Floats, reach: float, information: Floats
    ) -> tuple[tuple[Pair, ...], Floats]:
        """Refine all pairs that overlap at given poses, and make the poses agree with them."""
        lattice = self.lattice
        views = self.views(T)
        compared = self.overlapping(views)

        def one(pair: tuple[int, int]) -> tuple[Floats, int, float, float]:
            i, j = pair
            T_i_j, inliers = refine.align(thinned[i], thinned[j], se3.inverse(T[i]) @ T[j], reach)
            local = _moved(self.clouds[j], T[i] @ T_i_j) - views[i].centre
            raster = rasterise(local, lattice)
            r, evidence = correlate.compare(
                views[i].relief, views[i].raster.seen, relief(raster), raster.seen
            )
            return T_i_j, inliers, r, evidence

        found = self.each(one, compared)
        sound = [k for k, (_, _, r, evidence) in enumerate(found) if r > ALIKE and evidence > SURE]
        edges = [self.edge(*compared[k], found[k][0], found[k][3]) for k in sound]
        solution = graph.solve(T, edges, FINE * lattice.cell, information)
        faults = [
            f"reliefs do not match: correlation {r:.2f}"
            if r <= ALIKE
            else f"too little in common to be sure: evidence {evidence:.1f} of {SURE:g}"
            for _, _, r, evidence in found
        ]
        for k, believed, off in zip(sound, solution.believed, solution.off, strict=True):
            faults[k] = "" if believed > 0.5 else f"contradicts other pairs by {off:.3f} m"
        pairs = tuple(
            Pair(i, j, r, inliers, fault)
            for (i, j), (_, inliers, r, _), fault in zip(compared, found, faults, strict=True)
        )
        return pairs, solution.T_map_camera

    def edge(self, i: int, j: int, T_i_j: Floats, evidence: float) -> graph.Edge:
        """Return an edge felt over the footprint of frame j; more evidence counts for more."""
        cloud = self.clouds[j]
        some = cloud[:: max(1, len(cloud) // 2000)].astype(float)
        at = some.mean(axis=0)
        lever = float(np.sqrt(np.square(some - at).sum(axis=1).mean()))
        return graph.Edge(i, j, T_i_j, at, lever, min(evidence / PLAUSIBLE, 10.0))

    def start_information(self) -> Floats:
        """Return (N, 6, 6), the inverse covariance of the start."""
        one = np.zeros((6, 6))
        one[:3, :3], one[3:, 3:] = np.linalg.inv(self.V_t), np.linalg.inv(self.V_r)
        return np.repeat(one[None], len(self.clouds), axis=0)


def _moved(points: NDArray[np.float32], T: Floats) -> Floats:
    return np.asarray(points.astype(float) @ T[:3, :3].T + T[:3, 3])


def _towards(T_world_camera: Floats) -> Floats:
    """Return R_map_world (3, 3), whose z looks back at the sensors."""
    z = -T_world_camera[:, :3, 2].mean(axis=0)
    length = float(np.linalg.norm(z))
    z = z / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    aside = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = np.cross(np.cross(z, aside), z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
