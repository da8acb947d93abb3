"""The points of a patch beside its surface: what all passes over them share.

In the axes of its patch a surface is ``y_0 = phi(y_1, y_2) . q`` with
``phi = (1, u, v, u^2, u v, v^2)``. A point is walked along its viewing ray to the surface, where
``phi``, the normal ``n`` and the Jacobian are taken: at the point itself they would hang on its own
noise. It lies off by the way times ``n . ray``, whose variance is the range's times
``norm2 = (n . ray)^2 + eps |n|^2``; eps is for noise across the ray.

The points of a patch go through together, one stage for all of them after the other, as in
`kernels`: ``s`` (ROWS, points) is where a stage leaves what the next one reads.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numpy as np

from depthba.compiling import fast, inlined, kernel

TERMS = 6
"""Coefficients of a surface."""
# Share of the noise that is across the ray, squared.
ACROSS = 0.05
# Least cosine between ray and normal with which a point is walked.
GRAZING = 0.15
# Rows of a patch's points: where they lie; their rays; weights; feet, the slopes there; how far the
# points lie off, and how much they count for it.
HEIGHT, U, V, RAY_0, RAY_1, RAY_2, WEIGHT, FOOT_0, FOOT_U, FOOT_V = range(10)
SLOPE_U, SLOPE_V, NORM2, OFF, COUNTS = range(10, 15)
ROWS = 15


@kernel
def room(first, last, ends, views):
    """Return memory for the points of any of the patches."""
    most = 0
    for k in range(first, last):
        most = max(most, ends[views[k + 1]] - ends[views[k]])
    return np.empty((ROWS, most))


@fast
def _turn_view(points, weights, Q, o, rays, s, at):
    """Bring the points of a view into the axes of their patch, to columns from ``at`` on."""
    q00, q01, q02 = Q[0, 0], Q[0, 1], Q[0, 2]
    q10, q11, q12 = Q[1, 0], Q[1, 1], Q[1, 2]
    q20, q21, q22 = Q[2, 0], Q[2, 1], Q[2, 2]
    o0, o1, o2 = o[0], o[1], o[2]
    n = len(points)
    y, u, v, w = s[HEIGHT, at:], s[U, at:], s[V, at:], s[WEIGHT, at:]
    a0, a1, a2 = s[RAY_0, at:], s[RAY_1, at:], s[RAY_2, at:]
    for i in range(n):
        p0, p1, p2 = points[i, 0], points[i, 1], points[i, 2]
        r0 = q00 * p0 + q01 * p1 + q02 * p2
        r1 = q10 * p0 + q11 * p1 + q12 * p2
        r2 = q20 * p0 + q21 * p1 + q22 * p2
        y[i], u[i], v[i], w[i] = r0 + o0, r1 + o1, r2 + o2, weights[i]
        a0[i], a1[i], a2[i] = r0, r1, r2
    if rays:
        for i in range(n):
            shorter = 1.0 / np.sqrt(a0[i] * a0[i] + a1[i] * a1[i] + a2[i] * a2[i])
            a0[i] *= shorter
            a1[i] *= shorter
            a2[i] *= shorter


@kernel
def place(k, points, weights, ends, views, Q, o, rays, s):
    """Bring the points of a patch into its axes; return how many they are."""
    begin = ends[views[k]]
    for m in range(views[k], views[k + 1]):
        i, j = ends[m], ends[m + 1]
        _turn_view(points[i:j], weights[i:j], Q[m], o[m], rays, s, i - begin)
    return ends[views[k + 1]] - begin


@fast
def meet(n, q, rays, reach, s):
    """Walk the points of a patch to its surface: feet, slopes there, norms, how far they lie off.

    What the walk has not covered is left over at its end.
    """
    c0, c1, c2, c3, c4, c5 = q[0], q[1], q[2], q[3], q[4], q[5]
    ys, us, vs = s[HEIGHT], s[U], s[V]
    a0, a1, a2 = s[RAY_0], s[RAY_1], s[RAY_2]
    f0, fu, fv = s[FOOT_0], s[FOOT_U], s[FOOT_V]
    su, sv, norm2, off = s[SLOPE_U], s[SLOPE_V], s[NORM2], s[OFF]
    if not rays:
        for i in range(n):
            y, u, v = ys[i], us[i], vs[i]
            n1 = -(c1 + 2.0 * c3 * u + c4 * v)
            n2 = -(c2 + c4 * u + 2.0 * c5 * v)
            f0[i], fu[i], fv[i], su[i], sv[i] = y, u, v, n1, n2
            norm2[i] = 1.0 + n1 * n1 + n2 * n2
            off[i] = y - (c0 + u * (c1 + c3 * u + c4 * v) + v * (c2 + c5 * v))
        return
    for i in range(n):
        f0[i], fu[i], fv[i] = ys[i], us[i], vs[i]
        off[i] = 0.0
    for _ in range(2):
        for i in range(n):
            y, u, v = f0[i], fu[i], fv[i]
            r0, r1, r2 = a0[i], a1[i], a2[i]
            n1 = -(c1 + 2.0 * c3 * u + c4 * v)
            n2 = -(c2 + c4 * u + 2.0 * c5 * v)
            cosine = r0 + n1 * r1 + n2 * r2
            least = GRAZING * np.sqrt(1.0 + n1 * n1 + n2 * n2)
            steep = cosine if abs(cosine) > least else (least if cosine > 0.0 else -least)
            e = y - (c0 + u * (c1 + c3 * u + c4 * v) + v * (c2 + c5 * v))
            way = off[i] - e / steep
            way = way if way < reach else reach
            way = way if way > -reach else -reach
            off[i] = way
            f0[i], fu[i], fv[i] = ys[i] + way * r0, us[i] + way * r1, vs[i] + way * r2
    for i in range(n):
        y, u, v = f0[i], fu[i], fv[i]
        n1 = -(c1 + 2.0 * c3 * u + c4 * v)
        n2 = -(c2 + c4 * u + 2.0 * c5 * v)
        cosine = a0[i] + n1 * a1[i] + n2 * a2[i]
        e = y - (c0 + u * (c1 + c3 * u + c4 * v) + v * (c2 + c5 * v))
        su[i], sv[i] = n1, n2
        norm2[i] = cosine * cosine + ACROSS * (1.0 + n1 * n1 + n2 * n2)
        off[i] = e - off[i] * cosine


@fast
def weigh(n, square, s):
    """Say how much points count: Geman-McClure of squared scale, m^2; 0: no robust loss."""
    weight, norm2, off, counts = s[WEIGHT], s[NORM2], s[OFF], s[COUNTS]
    if square == 0.0:
        for i in range(n):
            counts[i] = weight[i] / norm2[i]
        return
    for i in range(n):
        w = weight[i] / norm2[i]
        share = square / (square + w * off[i] * off[i])
        counts[i] = w * share * share


@fast
def surface_sums(n, s, M, b):
    """Sum what points say of a surface: M (6, 6), its lower triangle, and b (6,).

    Products of terms are powers of u and v, of which there are fewer.
    """
    us, vs, off, counts = s[FOOT_U], s[FOOT_V], s[OFF], s[COUNTS]
    m00 = m10 = m01 = m20 = m11 = m02 = m30 = m21 = m12 = m03 = 0.0
    m40 = m31 = m22 = m13 = m04 = b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    for i in range(n):
        u, v, w, e = us[i], vs[i], counts[i], off[i]
        wu, wv = w * u, w * v
        wuu, wuv, wvv = wu * u, wu * v, wv * v
        uu, uv, vv = u * u, u * v, v * v
        m00 += w
        m10 += wu
        m01 += wv
        m20 += wuu
        m11 += wuv
        m02 += wvv
        m30 += wuu * u
        m21 += wuu * v
        m12 += wuv * v
        m03 += wvv * v
        m40 += wuu * uu
        m31 += wuu * uv
        m22 += wuu * vv
        m13 += wuv * vv
        m04 += wvv * vv
        b0 += w * e
        b1 += wu * e
        b2 += wv * e
        b3 += wuu * e
        b4 += wuv * e
        b5 += wvv * e
    M[0, 0], M[1, 0], M[1, 1], M[2, 0], M[2, 1], M[2, 2] = m00, m10, m20, m01, m11, m02
    M[3, 0], M[3, 1], M[3, 2], M[3, 3] = m20, m30, m21, m40
    M[4, 0], M[4, 1], M[4, 2], M[4, 3], M[4, 4] = m11, m21, m12, m31, m22
    M[5, 0], M[5, 1], M[5, 2], M[5, 3], M[5, 4], M[5, 5] = m02, m12, m03, m22, m13, m04
    b[0], b[1], b[2], b[3], b[4], b[5] = b0, b1, b2, b3, b4, b5


@kernel
def _factor(M, L):
    """Cholesky factor of a positive definite (6, 6) matrix; only its lower triangle is read."""
    for i in range(6):
        for j in range(i + 1):
            s = M[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(max(s, 1e-300)) if i == j else s / L[j, j]


@kernel
def forward(L, b):
    """Solve ``L x = b`` in place."""
    for i in range(6):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]


@kernel
def backward(L, b):
    """Solve ``L^T x = b`` in place."""
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@kernel
def firm(M, stiff, L):
    """Factor a surface's normal matrix; a term that no point holds is held by next to nothing."""
    for j in range(6):
        M[j, j] *= 1.0 + 1e-9
        if j > 2:
            M[j, j] += stiff
    _factor(M, L)


@inlined
def by_pose(J, i, s, pivot):
    """Derivative at a foot by a shift and a turn of the frame about its pivot, in patch axes."""
    n1, n2 = s[SLOPE_U, i], s[SLOPE_V, i]
    a0, a1, a2 = s[FOOT_0, i] - pivot[0], s[FOOT_U, i] - pivot[1], s[FOOT_V, i] - pivot[2]
    J[0], J[1], J[2] = 1.0, n1, n2
    J[3], J[4], J[5] = a1 * n2 - a2 * n1, a2 - a0 * n2, a0 * n1 - a1


@inlined
def by_surface(phi, i, s):
    """Derivative at a foot by the surface's coefficients, its sign turned."""
    u, v = s[FOOT_U, i], s[FOOT_V, i]
    phi[0], phi[1], phi[2] = 1.0, u, v
    phi[3], phi[4], phi[5] = u * u, u * v, v * v


@kernel
def into_map(H, V, out):
    """Columns of H (r, 6) from patch axes to map axes."""
    for r in range(H.shape[0]):
        for half in range(2):
            for a in range(3):
                s = 0.0
                for c in range(3):
                    s += H[r, 3 * half + c] * V[a, c]
                out[r, 3 * half + a] = s


@kernel
def local(frame, views, axes, centre, T, Q, o):
    """Fill Q (m, 3, 3) and o (m, 3): a point p of a view lies at ``Q p + o`` in its patch."""
    for k in range(len(views) - 1):
        for m in range(views[k], views[k + 1]):
            pose = T[frame[m]]
            for a in range(3):
                t = 0.0
                for c in range(3):
                    t += axes[k, c, a] * (pose[c, 3] - centre[k, c])
                    q = 0.0
                    for j in range(3):
                        q += axes[k, j, a] * pose[j, c]
                    Q[m, a, c] = q
                o[m, a] = t
