"""The passes over the points of the patches.

In the axes of its patch a surface is ``y_0 = phi(y_1, y_2) . q`` with
``phi = (1, u, v, u^2, u v, v^2)``. A point is walked along its viewing ray to the surface, where
``phi``, the normal ``n`` and the Jacobian are taken: at the point itself they would hang on its own
noise. It lies off by the way times ``n . ray``, whose variance is the range's times
``norm2 = (n . ray)^2 + eps |n|^2``; eps is for noise across the ray.

Points are sorted by patch and, within one, by frame: such a run of points is a *view*. All kernels
take patches ``first`` to ``last``, so that they can be dealt out over threads.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

TERMS = 6
"""Coefficients of a surface."""
# Share of the noise that is across the ray, squared.
ACROSS = 0.05
# Least cosine between ray and normal with which a point is walked.
GRAZING = 0.15


@nb.njit(cache=True, nogil=True, inline="always")
def _meet(p, Q, o, q, rays, reach, at):
    """Walk a point to its surface.

    Writes to ``at``: v, u and y of the foot, n_1 and n_2 (n_0 is 1), and norm2. Returns how far the
    point lies off.
    """
    r0 = Q[0, 0] * p[0] + Q[0, 1] * p[1] + Q[0, 2] * p[2]
    r1 = Q[1, 0] * p[0] + Q[1, 1] * p[1] + Q[1, 2] * p[2]
    r2 = Q[2, 0] * p[0] + Q[2, 1] * p[1] + Q[2, 2] * p[2]
    y, u, v = r0 + o[0], r1 + o[1], r2 + o[2]
    if not rays:
        n1 = -(q[1] + 2.0 * q[3] * u + q[4] * v)
        n2 = -(q[2] + q[4] * u + 2.0 * q[5] * v)
        at[0], at[1], at[2], at[3], at[4] = y, u, v, n1, n2
        at[5] = 1.0 + n1 * n1 + n2 * n2
        return y - (q[0] + u * (q[1] + q[3] * u + q[4] * v) + v * (q[2] + q[5] * v))
    length = np.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
    r0, r1, r2 = r0 / length, r1 / length, r2 / length
    way = 0.0
    for _ in range(2):
        fu, fv = u + way * r1, v + way * r2
        n1 = -(q[1] + 2.0 * q[3] * fu + q[4] * fv)
        n2 = -(q[2] + q[4] * fu + 2.0 * q[5] * fv)
        cosine = r0 + n1 * r1 + n2 * r2
        n = np.sqrt(1.0 + n1 * n1 + n2 * n2)
        if abs(cosine) < GRAZING * n:
            cosine = GRAZING * n if cosine > 0.0 else -GRAZING * n
        e = y + way * r0 - (q[0] + fu * (q[1] + q[3] * fu + q[4] * fv) + fv * (q[2] + q[5] * fv))
        way = min(max(way - e / cosine, -reach), reach)
    fu, fv = u + way * r1, v + way * r2
    n1 = -(q[1] + 2.0 * q[3] * fu + q[4] * fv)
    n2 = -(q[2] + q[4] * fu + 2.0 * q[5] * fv)
    cosine = r0 + n1 * r1 + n2 * r2
    e = y + way * r0 - (q[0] + fu * (q[1] + q[3] * fu + q[4] * fv) + fv * (q[2] + q[5] * fv))
    at[0], at[1], at[2], at[3], at[4] = y + way * r0, fu, fv, n1, n2
    at[5] = cosine * cosine + ACROSS * (1.0 + n1 * n1 + n2 * n2)
    # what the walk has not covered is left over at its end
    return e - way * cosine


@nb.njit(cache=True, nogil=True, inline="always")
def _weight(w, e, c2):
    """Geman-McClure weight of a residual, times that of its point; c2 of 0: no robust loss."""
    if c2 == 0.0:
        return w
    share = c2 / (c2 + w * e * e)
    return w * share * share


@nb.njit(cache=True, nogil=True, inline="always")
def _terms(phi, u, v):
    phi[0] = 1.0
    phi[1], phi[2] = u, v
    phi[3], phi[4], phi[5] = u * u, u * v, v * v


@nb.njit(cache=True, nogil=True)
def _factor(M, L):
    """Cholesky factor of a positive definite (6, 6) matrix; only its lower triangle is read."""
    for i in range(6):
        for j in range(i + 1):
            s = M[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(max(s, 1e-300)) if i == j else s / L[j, j]


@nb.njit(cache=True, nogil=True)
def _forward(L, b):
    """Solve ``L x = b`` in place."""
    for i in range(6):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]


@nb.njit(cache=True, nogil=True)
def _backward(L, b):
    """Solve ``L^T x = b`` in place."""
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@nb.njit(cache=True, nogil=True)
def _firm(M, stiff, L):
    """Factor a surface's normal matrix; a term that no point holds is held by next to nothing."""
    for j in range(6):
        M[j, j] *= 1.0 + 1e-9
        if j > 2:
            M[j, j] += stiff
    _factor(M, L)


@nb.njit(cache=True, nogil=True)
def fit(
    first, last, points, weights, ends, views, Q, o, reach, stiff, rays, c2, rounds, surface
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
        c2: squared scale of the robust loss, m^2; 0: none.
        rounds: of reweighting.
        surface: (k, 6), where to start, and where it ends.
    """
    phi, q, b, at = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6)
    M, L = np.zeros((6, 6)), np.zeros((6, 6))
    total = 0.0
    for k in range(first, last):
        for j in range(6):
            q[j] = surface[k, j]
        for _ in range(rounds):
            M[:] = 0.0
            b[:] = 0.0
            for m in range(views[k], views[k + 1]):
                for i in range(ends[m], ends[m + 1]):
                    e = _meet(points[i], Q[m], o[m], q, rays, reach[k], at)
                    _terms(phi, at[1], at[2])
                    w = _weight(weights[i] / at[5], e, c2)
                    for j in range(6):
                        e += phi[j] * q[j]
                    for j in range(6):
                        t = w * phi[j]
                        b[j] += t * e
                        for c in range(j + 1):
                            M[j, c] += t * phi[c]
            _firm(M, stiff[k], L)
            _forward(L, b)
            _backward(L, b)
            for j in range(6):
                q[j] = b[j]
        for j in range(6):
            surface[k, j] = q[j]
            if j > 2:
                total += stiff[k] * q[j] * q[j]
        for m in range(views[k], views[k + 1]):
            for i in range(ends[m], ends[m + 1]):
                e = _meet(points[i], Q[m], o[m], q, rays, reach[k], at)
                s = weights[i] / at[5] * e * e
                total += s if c2 == 0.0 else c2 * s / (c2 + s)
    return total


@nb.njit(cache=True, nogil=True)
def residuals(first, last, points, weights, ends, views, Q, o, reach, rays, surface, out):
    """Write to ``out`` (n,) how far every point lies off its surface, in units of its noise."""
    at = np.zeros(6)
    for k in range(first, last):
        for m in range(views[k], views[k + 1]):
            for i in range(ends[m], ends[m + 1]):
                e = _meet(points[i], Q[m], o[m], surface[k], rays, reach[k], at)
                out[i] = np.sqrt(weights[i] / at[5]) * e


@nb.njit(cache=True, nogil=True, inline="always")
def _jacobian(J, at, pivot):
    """Derivative by a shift and a turn of the frame about its pivot, in patch axes."""
    n1, n2 = at[3], at[4]
    a0, a1, a2 = at[0] - pivot[0], at[1] - pivot[1], at[2] - pivot[2]
    J[0], J[1], J[2] = 1.0, n1, n2
    J[3], J[4], J[5] = a1 * n2 - a2 * n1, a2 - a0 * n2, a0 * n1 - a1


@nb.njit(cache=True, nogil=True)
def _coupled(
    first, last, points, weights, Q, o, pivot, reach, rays, q, c2, phi, J, at, B, g, H, M, b
):  # fmt: skip
    """Sum the blocks of one view, in patch axes: B (6, 6), g (6,), H (6, 6), terms by pose.

    And add what they say of the surface to M (6, 6), its lower triangle, and b (6,).
    """
    B[:] = 0.0
    g[:] = 0.0
    H[:] = 0.0
    for i in range(first, last):
        e = _meet(points[i], Q, o, q, rays, reach, at)
        _terms(phi, at[1], at[2])
        w = _weight(weights[i] / at[5], e, c2)
        _jacobian(J, at, pivot)
        for a in range(6):
            t = w * J[a]
            g[a] += t * e
            for c in range(a + 1):
                B[a, c] += t * J[c]
            for j in range(6):
                H[j, a] += t * phi[j]
        for j in range(6):
            t = w * phi[j]
            b[j] += t * e
            for c in range(j + 1):
                M[j, c] += t * phi[c]
    for a in range(6):
        for c in range(a):
            B[c, a] = B[a, c]


@nb.njit(cache=True, nogil=True)
def _turned(H, V, out):
    """Columns of H (r, 6) from patch axes to map axes."""
    for r in range(H.shape[0]):
        for half in range(2):
            for a in range(3):
                s = 0.0
                for c in range(3):
                    s += H[r, 3 * half + c] * V[a, c]
                out[r, 3 * half + a] = s


@nb.njit(cache=True, nogil=True)
def gather(
    first, last, points, weights, ends, views, frame, Q, o, pivot, axes, reach, stiff, rays,
    surface, c2, A, g,
):  # fmt: skip
    """Add what some patches say of the poses to A (N, 6, N, 6) and g (N, 6); surfaces eliminated.

    ``pivot`` (m, 3) is where the frame of each view is turned about, in the axes of its patch.
    What is left of the surfaces' own gradient is followed to first order.
    """
    n = len(g)
    phi, J, at, own, b = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6)
    B, M, L = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    H, turned, row = np.zeros((n, 6, 6)), np.zeros((6, 6)), np.zeros((1, 6))
    column, once = np.zeros(6), np.zeros((6, 6))
    for k in range(first, last):
        V = axes[k]
        M[:] = 0.0
        b[:] = 0.0
        count = views[k + 1] - views[k]
        for x in range(count):
            m = views[k] + x
            f = frame[m]
            _coupled(
                ends[m], ends[m + 1], points, weights, Q[m], o[m], pivot[m], reach[k], rays,
                surface[k], c2, phi, J, at, B, own, H[x], M, b,
            )  # fmt: skip
            _turned(B, V, once)
            _turned(once.T, V, turned)
            _turned(own.reshape(1, 6), V, row)
            for a in range(6):
                g[f, a] += row[0, a]
                for c in range(6):
                    A[f, a, f, c] += turned[a, c]
        for j in range(3, 6):
            b[j] -= stiff[k] * surface[k, j]
        _firm(M, stiff[k], L)
        _forward(L, b)
        for x in range(count):
            _turned(H[x], V, turned)
            for a in range(6):
                for j in range(6):
                    column[j] = turned[j, a]
                _forward(L, column)
                s = 0.0
                for j in range(6):
                    H[x, j, a] = column[j]
                    s += column[j] * b[j]
                g[frame[views[k] + x], a] -= s
        for x in range(count):
            for z in range(count):
                f, h = frame[views[k] + x], frame[views[k] + z]
                for a in range(6):
                    for c in range(6):
                        s = 0.0
                        for j in range(6):
                            s += H[x, j, a] * H[z, j, c]
                        A[f, a, h, c] -= s


@nb.njit(cache=True, nogil=True)
def scores(
    first, last, points, weights, ends, views, frame, Q, o, pivot, axes, reach, stiff, rays,
    surface, c2, groups, out,
):  # fmt: skip
    """Add the reduced gradient of each group of points to ``out`` (kinds, groups, N, 6).

    ``groups`` (n, kinds) says which group a point is in.
    """
    n = out.shape[2]
    phi, J, at, own, b = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6)
    B, M, L = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    H, turned, row = np.zeros((n, 6, 6)), np.zeros((6, 6)), np.zeros((1, 6))
    column = np.zeros(6)
    for k in range(first, last):
        V, q = axes[k], surface[k]
        M[:] = 0.0
        count = views[k + 1] - views[k]
        for x in range(count):
            m = views[k] + x
            _coupled(
                ends[m], ends[m + 1], points, weights, Q[m], o[m], pivot[m], reach[k], rays,
                q, c2, phi, J, at, B, own, H[x], M, b,
            )  # fmt: skip
        _firm(M, stiff[k], L)
        for x in range(count):
            _turned(H[x], V, turned)
            for a in range(6):
                for j in range(6):
                    column[j] = turned[j, a]
                _forward(L, column)
                _backward(L, column)
                for j in range(6):
                    H[x, j, a] = column[j]
        for m in range(views[k], views[k + 1]):
            for i in range(ends[m], ends[m + 1]):
                e = _meet(points[i], Q[m], o[m], q, rays, reach[k], at)
                _terms(phi, at[1], at[2])
                wr = _weight(weights[i] / at[5], e, c2) * e
                _jacobian(J, at, pivot[m])
                _turned(J.reshape(1, 6), V, row)
                for kind in range(groups.shape[1]):
                    s = out[kind, groups[i, kind]]
                    for a in range(6):
                        s[frame[m], a] += wr * row[0, a]
                    for x in range(count):
                        f = frame[views[k] + x]
                        for a in range(6):
                            t = 0.0
                            for j in range(6):
                                t += phi[j] * H[x, j, a]
                            s[f, a] -= wr * t


@nb.njit(cache=True, nogil=True)
def moments(order, group, x, w, count, weight, mean, spread):
    """Fill count, weight, mean and scatter of every group of points."""
    for k in range(len(order)):
        i, j = order[k], group[k]
        count[j] += 1
        weight[j] += w[i]
        for a in range(3):
            mean[j, a] += w[i] * x[i, a]
    for j in range(len(count)):
        for a in range(3):
            mean[j, a] /= weight[j]
    for k in range(len(order)):
        i, j = order[k], group[k]
        for a in range(3):
            for c in range(3):
                spread[j, a, c] += w[i] * (x[i, a] - mean[j, a]) * (x[i, c] - mean[j, c])
