"""What a recording shows of the certainty: uncertain cells, ellipsoids, open directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from depthba import se3
from depthba.depth_map import DepthMap
from depthba.picture import sigma_colours, sigma_png, sigma_top
from depthba.result import Result
from eval.recorded_map import MESH_NODES, filled_heights, thinned, triangles

Floats = NDArray[np.float64]

ELLIPSOID = 0.35
"""Half the length of a long ellipsoid, as a share of the distance between cameras."""
LARGEST = 0.9
"""Ellipsoids are drawn no larger than that share: they would hide all else."""
ARROW = 0.8
"""Length of a unit direction's arrow, as a share of the distance between cameras."""
NO_SIGMA = 1e-9
"""m; a centre with less is fixed, and has no ellipsoid."""
LEAST_PART = 0.2
"""Parts of a direction, of unit length, that are shorter are not drawn."""
MOVE, TURN, TOO_LARGE = (255, 120, 40), (235, 80, 235), (255, 60, 60)


@dataclass(frozen=True)
class Scale:
    """How the ellipsoids were drawn, which their view must say."""

    factor: float
    """They are this many times larger than one standard deviation; 0: there are none."""
    cut: int
    """So many were too large to be drawn in full, and are red."""
    open_directions: int
    """Directions that the data leave open, drawn as arrows."""


def log_certainty(rec: rr.RecordingStream, result: Result, colours: NDArray[np.uint8]) -> Scale:
    """Record how certain a result is, once and for all.

    Args:
        rec: where to.
        result: with map, covariance and weak directions.
        colours: (N, 3), of the frames.

    """
    _surface(rec, result.depth_map)
    centres = result.T_world_camera[:, :3, 3]
    apart = camera_distance(centres)
    factor, cut = _ellipsoids(rec, centres, result.covariance, colours, apart)
    return Scale(factor, cut, _arrows(rec, result, apart))


def camera_distance(centres: Floats) -> float:
    """Return about how far apart cameras are whose centres are (N, 3), m.

    By the third nearest of each, which a pair of shots from one place does not make small.
    """
    others = min(3, len(centres) - 1)
    if others < 1:
        return 1.0
    distance = float(np.median(cKDTree(centres).query(centres, k=others + 1)[0][:, others]))
    # on a line the third is twice as far as the next one, on a grid not quite
    return 0.6 * distance if distance > 0 else 1.0


def round_factor(factor: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20, … (and 0.5, 0.2, …) that is no larger."""
    decade = 10.0 ** np.floor(np.log10(factor))
    return float(max(m * decade for m in (1.0, 2.0, 5.0) if m * decade <= factor * (1 + 1e-9)))


def _surface(rec: rr.RecordingStream, depth_map: DepthMap) -> None:
    """Record the map in the colours of its standard deviation, and a picture of that."""
    if not np.isfinite(depth_map.sigma).any():
        return
    filled = filled_heights(depth_map)
    step = int(np.ceil(np.sqrt(filled.size / (2 * MESH_NODES))))
    thin = thinned(depth_map, filled, step)
    surface = rr.Mesh3D(
        vertex_positions=thin.vertices().reshape(-1, 3).astype(np.float32),
        triangle_indices=triangles(np.isfinite(depth_map.heights[::step, ::step])),
        vertex_colors=sigma_colours(thin, sigma_top(depth_map)).reshape(-1, 3),
    )
    rec.log("certainty/surface", surface, static=True)
    image = rr.EncodedImage(contents=sigma_png(depth_map), media_type="image/png")
    rec.log("certainty/picture", image, static=True)


def _ellipsoids(
    rec: rr.RecordingStream,
    centres: Floats,
    covariance: Floats,
    colours: NDArray[np.uint8],
    apart: float,
) -> tuple[float, int]:
    """Record one standard deviation of the centres, enlarged; return by how much, and those cut."""
    n = len(centres)
    blocks = covariance.reshape(n, 6, n, 6)[np.arange(n), :3, np.arange(n), :3]
    usable = np.asarray(np.isfinite(blocks).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(usable[:, None, None], blocks, 0.0))
    sigmas = np.sqrt(np.maximum(values, 0.0))
    longest: Floats = sigmas[:, -1]
    free = np.flatnonzero(longest > NO_SIGMA)
    if not len(free):
        return 0.0, 0
    factor = round_factor(ELLIPSOID * apart / float(np.median(longest[free])))
    half = factor * sigmas[free]
    too_large = np.flatnonzero(half[:, -1] > LARGEST * apart)
    half = np.minimum(half, LARGEST * apart)
    half = np.maximum(half, 0.05 * half[:, -1:])  # a disc without thickness is not seen
    turns = vectors[free]
    turns[:, :, 0] *= np.sign(np.linalg.det(turns))[:, None]
    tints = colours[free].copy()
    tints[too_large] = TOO_LARGE
    labels = [
        f"frame {i}: {' × '.join(f'{1e3 * s:.3g}' for s in sigmas[i, ::-1])} mm" for i in free
    ]
    shown = rr.Ellipsoids3D(
        centers=centres[free],
        half_sizes=half,
        quaternions=se3.quaternion(se3.make(turns, np.zeros((len(turns), 3)))),
        colors=tints,
        fill_mode=rr.components.FillMode.Solid,
        labels=labels,
        show_labels=False,
    )
    rec.log("certainty/ellipsoids", shown, static=True)
    return factor, len(too_large)


def _arrows(rec: rr.RecordingStream, result: Result, apart: float) -> int:
    """Record the weak directions as arrows at their frames' centres; return how many there are."""
    R_world_map = result.depth_map.T_map_world[:3, :3].T
    row = {frame: i for i, frame in enumerate(result.frame_ids)}
    origins, vectors, tints, labels = [], [], [], []
    for weak in result.weak:
        centre = result.T_world_camera[row[weak.frame], :3, 3]
        for part, tint in ((weak.direction[:3], MOVE), (weak.direction[3:], TURN)):
            if np.linalg.norm(part) < LEAST_PART:
                continue
            origins.append(centre)
            vectors.append(ARROW * apart * (R_world_map @ part))
            tints.append(tint)
            labels.append(f"frame {weak.frame}: {weak.name}")
    if origins:
        arrows = rr.Arrows3D(
            origins=np.array(origins),
            vectors=np.array(vectors),
            colors=tints,
            radii=0.035 * apart,
            labels=labels,
            show_labels=False,
        )
        rec.log("certainty/open", arrows, static=True)
    return len(result.weak)
