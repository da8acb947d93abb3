"""The passes over the points of the patches: fitting surfaces, and what these say of the poses.

Points are sorted by patch and, within one, by frame: such a run of points is a *view*. All kernels
take patches ``first`` to ``last``, so that they can be dealt out over threads.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numpy as np

from depthba.compiling import fast, fast_part, kernel, part
from depthba.optimiser.patch_points import (
    CHUNK,
    COUNTS,
    NORM2,
    OFF,
    WEIGHT,
    backward,
    by_pose,
    by_surface,
    firm,
    forward,
    into_map,
    meet,
    place,
    room,
    spot,
    surface_sums,
    weigh,
)

# Columns of a view's sums: what its pose and the surface change, and how far points lie off; a
# whole number of vector registers.
POSE, SURFACE, ERROR, COLUMNS = 0, 6, 12, 16


@part
def _charge(n, square, s, out):
    """Return what the points cost, m^2; how far they lie off goes to ``out``."""
    total = 0.0
    for first in range(0, n, CHUNK):
        last = min(first + CHUNK, n)
        total += _charge_chunk(square, s[spot(first) :], out[first:last])
    return total


@fast_part
def _charge_chunk(square, s, out):
    total = 0.0
    for i in range(len(out)):
        e = np.sqrt(s[WEIGHT + i] / s[NORM2 + i]) * s[OFF + i]
        out[i] = e
        total += square * e * e / (square + e * e) if square > 0.0 else e * e
    return total


@kernel
def fit(
    first, last, points, weights, ends, views, Q, o, reach, stiff, rays, square, rounds, surface,
    off,
):  # fmt: skip
    """Fit the surfaces of some patches; return what they cost, m^2.

    Args:
        first: the first patch.
        last: the one past the last.
        points: (n, 3), sensor frame.
        weights: (n,).
        ends: (m + 1,), the points of each view.
        views: (k + 1,), the views of each patch.
        Q: (m, 3, 3), with o (m, 3): ``y = Q p + o``.
        o: see Q.
        reach: (k,), m: how far a point is walked at most.
        stiff: (k,), m^4: what a squared second-order coefficient costs.
        rays: whether points lie on rays from the origin of their sensor.
        square: squared scale of the robust loss, m^2; 0: none.
        rounds: of reweighting.
        surface: (k, 6), where to start, and where it ends.
        off: (n,) gets how far every point lies off its surface, in units of its noise.
    """
    s = room(first, last, ends, views)
    b, M, L = np.zeros(6), np.zeros((6, 6)), np.zeros((6, 6))
    total = 0.0
    for k in range(first, last):
        q = surface[k]
        n = place(k, points, weights, ends, views, Q, o, rays, s)
        for _ in range(rounds):
            meet(n, q, rays, reach[k], s)
            weigh(n, square, s)
            surface_sums(n, s, M, b)
            # the step goes to the coefficients themselves, which stiffness holds to nothing
            for i in range(6):
                for j in range(i + 1):
                    b[i] += M[i, j] * q[j]
                    if i != j:
                        b[j] += M[i, j] * q[i]
            firm(M, stiff[k], L)
            forward(L, b)
            backward(L, b)
            for j in range(6):
                q[j] = b[j]
        for j in range(3, 6):
            total += stiff[k] * q[j] * q[j]
        meet(n, q, rays, reach[k], s)
        total += _charge(n, square, s, off[ends[views[k]] :])
    return total


@fast_part
def _view_sums(first, last, pivot, s, z, Z):
    """Sum ``w z_a z_c`` over a view's points, a of the pose: Z (6, COLUMNS)."""
    Z[:] = 0.0
    for i in range(first, last):
        at = spot(i)
        by_pose(z[POSE:SURFACE], at, s, pivot)
        by_surface(z[SURFACE:ERROR], at, s)
        z[ERROR] = s[OFF + at]
        w = s[COUNTS + at]
        for a in range(6):
            t = w * z[a]
            for c in range(COLUMNS):
                Z[a, c] += t * z[c]


@kernel
def gather(
    first, last, points, weights, ends, views, frame, Q, o, pivot, axes, reach, stiff, rays,
    surface, square, A, g,
):  # fmt: skip
    """Add what some patches say of the poses to A (N, 6, N, 6) and g (N, 6); surfaces eliminated.

    ``pivot`` (m, 3) is where the frame of each view is turned about, in the axes of its patch.
    What is left of the surfaces' own gradient is followed to first order. Blocks of A above the
    diagonal are left out.
    """
    s, frames = room(first, last, ends, views), len(g)
    b, M, L = np.zeros(6), np.zeros((6, 6)), np.zeros((6, 6))
    z, Z = np.zeros(COLUMNS), np.zeros((6, COLUMNS))
    H, row = np.zeros((frames, 6, 6)), np.zeros((1, 6))
    turned, once = np.zeros((6, 6)), np.zeros((6, 6))
    for k in range(first, last):
        V = axes[k]
        n = place(k, points, weights, ends, views, Q, o, rays, s)
        meet(n, surface[k], rays, reach[k], s)
        weigh(n, square, s)
        surface_sums(n, s, M, b)
        for j in range(3, 6):
            b[j] -= stiff[k] * surface[k, j]
        firm(M, stiff[k], L)
        forward(L, b)
        begin = ends[views[k]]
        count = views[k + 1] - views[k]
        for x in range(count):
            m = views[k] + x
            f = frame[m]
            _view_sums(ends[m] - begin, ends[m + 1] - begin, pivot[m], s, z, Z)
            into_map(Z[:, POSE:SURFACE], V, once)
            into_map(once.T, V, turned)
            for a in range(6):
                for c in range(6):
                    A[f, a, f, c] += turned[a, c]
            # rows of H: the pose in map axes; columns: the surface in units of its certainty
            into_map(Z[:, SURFACE:ERROR].T, V, once)
            into_map(Z[:, ERROR : ERROR + 1].T, V, row)
            for a in range(6):
                h = H[x, a]
                for j in range(6):
                    h[j] = once[j, a]
                forward(L, h)
                told = row[0, a]
                for j in range(6):
                    told -= h[j] * b[j]
                g[f, a] += told
        for x in range(count):
            for y in range(x + 1):
                f, h = frame[views[k] + x], frame[views[k] + y]
                for a in range(6):
                    for c in range(6):
                        t = 0.0
                        for j in range(6):
                            t += H[x, a, j] * H[y, c, j]
                        A[f, a, h, c] -= t


@kernel
def scores(
    first, last, points, weights, ends, views, frame, Q, o, pivot, axes, reach, stiff, rays,
    surface, square, groups, out,
):  # fmt: skip
    """Add the reduced gradient of each group of points to ``out`` (kinds, groups, N, 6).

    ``groups`` (n, kinds) says which group a point is in.
    """
    s, frames = room(first, last, ends, views), out.shape[2]
    phi, J, b, M, L = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros((6, 6)), np.zeros((6, 6))
    z, Z = np.zeros(COLUMNS), np.zeros((6, COLUMNS))
    H, once, row = np.zeros((frames, 6, 6)), np.zeros((6, 6)), np.zeros((1, 6))
    for k in range(first, last):
        V = axes[k]
        n = place(k, points, weights, ends, views, Q, o, rays, s)
        meet(n, surface[k], rays, reach[k], s)
        weigh(n, square, s)
        surface_sums(n, s, M, b)
        firm(M, stiff[k], L)
        begin = ends[views[k]]
        count = views[k + 1] - views[k]
        for x in range(count):
            m = views[k] + x
            _view_sums(ends[m] - begin, ends[m + 1] - begin, pivot[m], s, z, Z)
            into_map(Z[:, SURFACE:ERROR].T, V, once)
            for a in range(6):
                for j in range(6):
                    H[x, a, j] = once[j, a]
                forward(L, H[x, a])
                backward(L, H[x, a])
        for m in range(views[k], views[k + 1]):
            for i in range(ends[m], ends[m + 1]):
                at = spot(i - begin)
                by_pose(J, at, s, pivot[m])
                by_surface(phi, at, s)
                into_map(J.reshape(1, 6), V, row)
                wr = s[COUNTS + at] * s[OFF + at]
                for kind in range(groups.shape[1]):
                    to = out[kind, groups[i, kind]]
                    for a in range(6):
                        to[frame[m], a] += wr * row[0, a]
                    for x in range(count):
                        f = frame[views[k] + x]
                        for a in range(6):
                            t = 0.0
                            for j in range(6):
                                t += phi[j] * H[x, a, j]
                            to[f, a] -= wr * t


@kernel
def medians(begin, end, these, ends, off, out):
    """Write to ``out`` (k,) the median size of the values of some runs; one ends, one begins.

    Of the runs ``begin`` to ``end`` of ``these`` alone.
    """
    most = 0
    for k in these[begin:end]:
        most = max(most, ends[k + 1] - ends[k])
    space = np.empty(most)
    for j in range(begin, end):
        first, last = ends[these[j]], ends[these[j] + 1]
        for i in range(first, last):
            space[i - first] = abs(off[i])
        sizes = space[: last - first]
        sizes.sort()
        out[j] = sizes[(last - first) // 2]


@fast
def charge_of(off, square):
    """Return the Geman-McClure cost of values (n,) at a squared scale, m^2."""
    total = 0.0
    for i in range(len(off)):
        e2 = off[i] * off[i]
        total += e2 / (square + e2)
    return square * total
