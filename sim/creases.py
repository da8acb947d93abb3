"""Normals of the curved surface that flat faces stand for, so that light falls on it smoothly."""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np
from numpy.typing import NDArray

_FLAT = 1e-7
"""A corner's normal this near its face's (1 - cosine) is the face's own."""


def crease(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], cosine: float
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The curved faces (k,) of a mesh, and unit normals (k, 3, 3) at their corners.

    A corner's normal is the mean, weighted by angle, of the faces around its vertex whose normals
    are within a crease angle of its own face's, given by its cosine.
    """
    normals = np.empty((len(faces), 3, 3), np.float32)
    curved = np.empty(len(faces), np.bool_)
    _bend(vertices, faces, cosine, normals, curved)
    chosen = np.flatnonzero(curved)
    return chosen, normals[chosen]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _bend(vertices, faces, cosine, normals, curved):
    own, angle = np.zeros((len(faces), 3)), np.zeros((len(faces), 3))
    first = np.zeros(len(vertices) + 2, np.int64)
    for k in range(len(faces)):
        a, b, c = vertices[faces[k, 0]], vertices[faces[k, 1]], vertices[faces[k, 2]]
        n = np.cross(b - a, c - a)
        length = np.sqrt(n @ n)
        if length > 0.0:
            own[k] = n / length
        for j in range(3):
            p = vertices[faces[k, j]]
            u, v = vertices[faces[k, (j + 1) % 3]] - p, vertices[faces[k, (j + 2) % 3]] - p
            across = np.cross(u, v)
            angle[k, j] = np.arctan2(np.sqrt(across @ across), u @ v)
            first[faces[k, j] + 2] += 1
    # The faces around each vertex, one vertex after the other.
    for i in range(2, len(first)):
        first[i] += first[i - 1]
    around = np.empty((first[-1], 2), np.int64)
    for k in range(len(faces)):
        for j in range(3):
            at = first[faces[k, j] + 1]
            around[at, 0], around[at, 1] = k, j
            first[faces[k, j] + 1] += 1
    total = np.empty(3)
    for k in range(len(faces)):
        curved[k] = False
        for j in range(3):
            total[:] = 0.0
            vertex = faces[k, j]
            for at in range(first[vertex], first[vertex + 1]):
                f, corner = around[at]
                if own[f] @ own[k] > cosine:
                    total += angle[f, corner] * own[f]
            length = np.sqrt(total @ total)
            mean = total / length if length > 0.0 else own[k]
            normals[k, j, 0], normals[k, j, 1], normals[k, j, 2] = mean[0], mean[1], mean[2]
            curved[k] |= 1.0 - mean @ own[k] > _FLAT
