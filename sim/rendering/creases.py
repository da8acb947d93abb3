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


@nb.njit(cache=True, nogil=True)
def _side(vertices, a, b):
    return (
        vertices[b, 0] - vertices[a, 0],
        vertices[b, 1] - vertices[a, 1],
        vertices[b, 2] - vertices[a, 2],
    )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _bend(vertices, faces, cosine, normals, curved):
    own, angle = np.zeros((len(faces), 3)), np.zeros((len(faces), 3))
    first = np.zeros(len(vertices) + 2, np.int64)
    for k in range(len(faces)):
        for j in range(3):
            a, b, c = faces[k, j], faces[k, (j + 1) % 3], faces[k, (j + 2) % 3]
            ux, uy, uz = _side(vertices, a, b)
            vx, vy, vz = _side(vertices, a, c)
            x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0.0:
                own[k, 0], own[k, 1], own[k, 2] = x / length, y / length, z / length
            angle[k, j] = np.arctan2(length, ux * vx + uy * vy + uz * vz)
            first[a + 2] += 1
    # The faces around each vertex, one vertex after the other.
    for i in range(2, len(first)):
        first[i] += first[i - 1]
    around, corner = np.empty(first[-1], np.int64), np.empty(first[-1], np.int64)
    for k in range(len(faces)):
        for j in range(3):
            at = first[faces[k, j] + 1]
            around[at], corner[at] = k, j
            first[faces[k, j] + 1] += 1
    for k in range(len(faces)):
        curved[k] = False
        nx, ny, nz = own[k, 0], own[k, 1], own[k, 2]
        for j in range(3):
            x, y, z = 0.0, 0.0, 0.0
            for at in range(first[faces[k, j]], first[faces[k, j] + 1]):
                f = around[at]
                if own[f, 0] * nx + own[f, 1] * ny + own[f, 2] * nz > cosine:
                    weight = angle[f, corner[at]]
                    x += weight * own[f, 0]
                    y += weight * own[f, 1]
                    z += weight * own[f, 2]
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0.0:
                x, y, z = x / length, y / length, z / length
            else:
                x, y, z = nx, ny, nz
            normals[k, j, 0], normals[k, j, 1], normals[k, j, 2] = x, y, z
            curved[k] |= 1.0 - (x * nx + y * ny + z * nz) > _FLAT
