"""The residuals and their normal equations in plain NumPy: slow, and the judge of the fast ones.

The vertical residual follows "Correspondence-Free Multiview Point Cloud Registration via
Depth-Guided Joint Optimisation" to the letter; the range residual is described in
`depthba/optimiser/kernels.py`. Point by point, row by row: nothing is shared with what is judged.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LATERAL, GRAZING, SHORT = 0.05, 0.3, 0.5


@dataclass(frozen=True)
class Map:
    """Heights (ny, nx) over nodes at ``origin + spacing * (x, y)``."""

    heights: Floats
    origin: Floats
    spacing: float

    def cell(self, xy: Floats) -> tuple[int, int, Floats] | None:
        """Return the cell's lower corner and the weights H of its nodes (00, 10, 01, 11).

        None where one of the four nodes has no central difference.
        """
        x, y = (xy - self.origin) / self.spacing
        m, n = int(np.floor(x)), int(np.floor(y))
        ny, nx = self.heights.shape
        if min(m, n) < 1 or m + 1 > nx - 2 or n + 1 > ny - 2:
            return None
        a, b = x - m, y - n
        return m, n, np.array([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])

    def read(self, cell: tuple[int, int, Floats]) -> tuple[float, Floats]:
        """Return the height and n = (-dD/dx, -dD/dy, 1), from the nodes' central differences."""
        m, n, H = cell
        D, height, gradient = self.heights, 0.0, np.zeros(2)
        for h, (j, i) in zip(H, [(n, m), (n, m + 1), (n + 1, m), (n + 1, m + 1)], strict=True):
            height += h * D[j, i]
            central = np.array([D[j, i + 1] - D[j, i - 1], D[j + 1, i] - D[j - 1, i]])
            gradient += h * central / (2 * self.spacing)
        return height, np.array([-gradient[0], -gradient[1], 1.0])

    def row(self, cell: tuple[int, int, Floats]) -> Floats:
        """Return H spread over all heights, flattened."""
        m, n, H = cell
        out = np.zeros_like(self.heights)
        out[n : n + 2, m : m + 2] = H.reshape(2, 2)
        return out.ravel()


@dataclass(frozen=True)
class Residual:
    """One point's, ``r / norm`` metres, and the rows of r for [tau, phi] and for the heights."""

    r: float
    norm: float
    pose: Floats
    heights: Floats
    n_dot_u: float
    walked: float
    foot: Floats


def vertical(p: Floats, T: Floats, pivot: Floats, D: Map, slope: bool = False) -> Residual | None:
    """Return the paper's residual, ``[p']_z - D([p']_xy / s)``, or None off the map."""
    q = T[:3, :3] @ p + T[:3, 3]
    cell = D.cell(q[:2])
    if cell is None:
        return None
    height, n = D.read(cell)
    norm = float(np.linalg.norm(n)) if slope else 1.0
    return Residual(
        q[2] - height, norm, _pose_row(n, q - pivot), -D.row(cell), 1.0, 0.0, q
    )  # fmt: skip


def ranged(
    p: Floats, T: Floats, pivot: Floats, D: Map, front: float, cap: float
) -> Residual | None:
    """Return the residual along the viewing ray: Newton steps to the foot, all taken there.

    The second only where the first was long.
    """
    q = T[:3, :3] @ p + T[:3, 3]
    u = T[:3, :3] @ p / np.linalg.norm(p)
    walked, foot = 0.0, q
    for _ in range(2):
        cell = D.cell(foot[:2])
        if cell is None:
            return None
        height, n = D.read(cell)
        guarded = front * max(front * (n @ u), GRAZING)
        before = walked
        walked = float(np.clip(walked + (foot[2] - height) / guarded, -cap, cap))
        foot = q - walked * u
        if abs(walked - before) < SHORT * D.spacing:
            break
    cell = D.cell(foot[:2])
    if cell is None:
        return None
    height, n = D.read(cell)
    r = foot[2] - height + walked * (n @ u)
    norm = float(np.sqrt((n @ u) ** 2 + LATERAL * (n @ n)))
    return Residual(r, norm, _pose_row(n, foot - pivot), -D.row(cell), float(n @ u), walked, foot)


def _pose_row(n: Floats, arm: Floats) -> Floats:
    """``n . dq`` for ``q <- Exp(phi) (q - c) + c + tau``: ``dq = tau + phi x (q - c)``."""
    return np.concatenate([n, [n @ np.cross(axis, arm) for axis in np.eye(3)]])


def neighbours(shape: tuple[int, int], smooth: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the pairs of flattened neighbouring nodes that the smoothing term ties together."""
    ny, nx = shape
    for y in range(ny):
        for x in range(nx):
            for v, w in ((y, x + 1), (y + 1, x)):
                if v < ny and w < nx and smooth[y, x] and smooth[v, w]:
                    yield y * nx + x, v * nx + w


@dataclass(frozen=True)
class Dense:
    """The normal equations ``H [poses; heights] = -g``, and what every point said."""

    H: Floats
    g: Floats
    cost: float
    used: int
    weights: tuple[Floats, ...]
    residuals: tuple[Floats, ...]


def normal_equations(
    clouds: list[Floats],
    T_map_camera: Floats,
    pivots: Floats,
    D: Map,
    *,
    along_ray: bool,
    slope: bool,
    cap: float,
    c: float,
    charge: float,
    smoothing: float,
    smooth: NDArray[np.bool_],
) -> Dense:
    """Build them by explicit rows. ``clouds`` are (n, 5): point, inverse noise, share."""
    frames, nodes = len(clouds), D.heights.size
    rows, values, factors = [], [], []
    cost, used, weights, residuals = 0.0, 0, [], []
    for i, (cloud, T) in enumerate(zip(clouds, T_map_camera, strict=True)):
        front = 1.0 if (T[:3, :3] @ cloud[:, :3].mean(axis=0))[2] > 0 else -1.0
        weights.append(np.zeros(len(cloud)))
        residuals.append(np.full(len(cloud), np.nan))
        for k, (*p, own, share) in enumerate(cloud):
            if along_ray:
                found = ranged(np.array(p), T, pivots[i], D, front, cap)
            else:
                found = vertical(np.array(p), T, pivots[i], D, slope)
            if found is None or share == 0:
                cost += share * charge
                continue
            e = found.r / found.norm * own
            psi = (c**2 / (c**2 + e**2)) ** 2 if c else 1.0
            cost += share * (c**2 * e**2 / (c**2 + e**2) if c else e**2)
            weights[i][k], residuals[i][k] = psi, e
            used += 1
            row = np.zeros(6 * frames + nodes)
            row[6 * i : 6 * i + 6], row[6 * frames :] = found.pose, found.heights
            rows.append(row)
            values.append(found.r)
            factors.append(share * psi * (own / found.norm) ** 2)
    flat = D.heights.ravel()
    for one, other in neighbours(D.heights.shape, smooth):
        row = np.zeros(6 * frames + nodes)
        row[6 * frames + one], row[6 * frames + other] = 1.0, -1.0
        rows.append(row)
        values.append(flat[one] - flat[other])
        factors.append(smoothing)
        cost += smoothing * (flat[one] - flat[other]) ** 2
    J, r, w = np.array(rows), np.array(values), np.array(factors)
    H = J.T @ (w[:, None] * J)
    # what nothing ties to its neighbours is damped, where there is anything at all
    loose = 6 * frames + np.flatnonzero(~smooth.ravel())
    loose = loose[np.diag(H)[loose] > 0]
    H[loose, loose] += 2 * smoothing
    return Dense(H, J.T @ (w * r), cost, used, tuple(weights), tuple(residuals))
