"""The points of a patch beside its surface: what all passes over them share.

In the axes of its patch a surface is ``y_0 = phi(y_1, y_2) . q`` with
``phi = (1, u, v, u^2, u v, v^2)``. A point is walked along its viewing ray to the surface, where
``phi``, the normal ``n`` and the Jacobian are taken: at the point itself they would hang on its own
noise. It lies off by the way times ``n . ray``, whose variance is the range's times
``norm2 = (n . ray)^2 + eps |n|^2``; eps is for noise across the ray.

The points of a patch go through in chunks, one stage after the other, as in `kernels`: ``s`` is
where a stage leaves what the next one reads, chunk by chunk, and `spot` where in it a point begins.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numpy as np

from depthba.compiling import fast_part, inlined, kernel, part

TERMS = 6
"""Coefficients of a surface."""
# Share of the noise that is across the ray, squared.
ACROSS = 0.05
# Least cosine between ray and normal with which a point is walked.
GRAZING = 0.15
# Least squared length of a ray, m^2: that of a point in the sensor's centre is not nothing.
TINY = 1e-200
# Points of a chunk.
CHUNK = 64
# Where the rows of a chunk begin: where points lie; their rays; weights; feet, the slopes there;
# how far the points lie off, and how much they count for it.
HEIGHT, U, V, RAY_0, RAY_1, RAY_2, WEIGHT = range(0, 7 * CHUNK, CHUNK)
FOOT_0, FOOT_U, FOOT_V, SLOPE_U, SLOPE_V = range(7 * CHUNK, 12 * CHUNK, CHUNK)
NORM2, OFF, COUNTS = range(12 * CHUNK, 15 * CHUNK, CHUNK)
ALL = 15 * CHUNK


@inlined
def spot(i):
    """Return where the rows of the ``i``-th point of a patch are."""
    return (i // CHUNK) * ALL + i % CHUNK


@part
def room(first, last, ends, views):
    """Return memory for the points of any of the patches."""
    most = 0
    for k in range(first, last):
        most = max(most, ends[views[k + 1]] - ends[views[k]])
    return np.empty(-(-most // CHUNK) * ALL)


@fast_part
def _turn(points, weights, Q, o, rays, s, at):
    """Bring some points of a view into the axes of their patch, to columns from ``at`` on."""
    q00, q01, q02 = Q[0, 0], Q[0, 1], Q[0, 2]
    q10, q11, q12 = Q[1, 0], Q[1, 1], Q[1, 2]
    q20, q21, q22 = Q[2, 0], Q[2, 1], Q[2, 2]
    o0, o1, o2 = o[0], o[1], o[2]
    for i in range(points.shape[0]):
        p0, p1, p2 = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        r0 = q00 * p0 + q01 * p1 + q02 * p2
        r1 = q10 * p0 + q11 * p1 + q12 * p2
        r2 = q20 * p0 + q21 * p1 + q22 * p2
        k = at + i
        s[HEIGHT + k], s[U + k], s[V + k], s[WEIGHT + k] = r0 + o0, r1 + o1, r2 + o2, weights[i]
        shorter = 1.0 / np.sqrt(r0 * r0 + r1 * r1 + r2 * r2 + TINY) if rays else 1.0
        s[RAY_0 + k], s[RAY_1 + k], s[RAY_2 + k] = r0 * shorter, r1 * shorter, r2 * shorter


@part
def place(k, points, weights, ends, views, Q, o, rays, s):
    """Bring the points of a patch into its axes; return how many they are."""
    begin = ends[views[k]]
    for m in range(views[k], views[k + 1]):
        i, last = ends[m], ends[m + 1]
        while i < last:
            at = (i - begin) % CHUNK
            j = min(last, i + CHUNK - at)
            chunk = s[spot(i - begin) - at :]
            _turn(points[i:j], weights[i:j], Q[m], o[m], rays, chunk, at)
            i = j
    return ends[views[k + 1]] - begin


@fast_part
def meet(n, q, rays, reach, s):
    """Walk the points of a patch to its surface: feet, slopes there, norms, how far they lie off.

    What the walk has not covered is left over at its end.
    """
    for first in range(0, n, CHUNK):
        chunk = s[spot(first) :]
        if rays:
            _meet_along(min(CHUNK, n - first), q, reach, chunk)
        else:
            _meet_upright(min(CHUNK, n - first), q, chunk)


@fast_part
def _meet_upright(n, q, s):
    c0, c1, c2, c3, c4, c5 = q[0], q[1], q[2], q[3], q[4], q[5]
    for i in range(n):
        y, u, v = s[HEIGHT + i], s[U + i], s[V + i]
        n1 = -(c1 + 2.0 * c3 * u + c4 * v)
        n2 = -(c2 + c4 * u + 2.0 * c5 * v)
        s[FOOT_0 + i], s[FOOT_U + i], s[FOOT_V + i] = y, u, v
        s[SLOPE_U + i], s[SLOPE_V + i] = n1, n2
        s[NORM2 + i] = 1.0 + n1 * n1 + n2 * n2
        s[OFF + i] = y - (c0 + u * (c1 + c3 * u + c4 * v) + v * (c2 + c5 * v))


@fast_part
def _meet_along(n, q, reach, s):
    c0, c1, c2, c3, c4, c5 = q[0], q[1], q[2], q[3], q[4], q[5]
    for i in range(n):
        y0, u0, v0 = s[HEIGHT + i], s[U + i], s[V + i]
        r0, r1, r2 = s[RAY_0 + i], s[RAY_1 + i], s[RAY_2 + i]
        y, u, v, way = y0, u0, v0, 0.0
        for _ in range(2):
            n1 = -(c1 + 2.0 * c3 * u + c4 * v)
            n2 = -(c2 + c4 * u + 2.0 * c5 * v)
            cosine = r0 + n1 * r1 + n2 * r2
            least = GRAZING * np.sqrt(1.0 + n1 * n1 + n2 * n2)
            steep = cosine if abs(cosine) > least else (least if cosine > 0.0 else -least)
            e = y - (c0 + u * (c1 + c3 * u + c4 * v) + v * (c2 + c5 * v))
            way = way - e / steep
            way = way if way < reach else reach
            way = way if way > -reach else -reach
            y, u, v = y0 + way * r0, u0 + way * r1, v0 + way * r2
        n1 = -(c1 + 2.0 * c3 * u + c4 * v)
        n2 = -(c2 + c4 * u + 2.0 * c5 * v)
        cosine = r0 + n1 * r1 + n2 * r2
        e = y - (c0 + u * (c1 + c3 * u + c4 * v) + v * (c2 + c5 * v))
        s[FOOT_0 + i], s[FOOT_U + i], s[FOOT_V + i] = y, u, v
        s[SLOPE_U + i], s[SLOPE_V + i] = n1, n2
        s[NORM2 + i] = cosine * cosine + ACROSS * (1.0 + n1 * n1 + n2 * n2)
        s[OFF + i] = e - way * cosine


@fast_part
def weigh(n, square, s):
    """Say how much points count: Geman-McClure of squared scale, m^2; 0: no robust loss."""
    for first in range(0, n, CHUNK):
        _weigh(min(CHUNK, n - first), square, s[spot(first) :])


@fast_part
def _weigh(n, square, s):
    for i in range(n):
        w, e = s[WEIGHT + i] / s[NORM2 + i], s[OFF + i]
        share = square / (square + w * e * e) if square > 0.0 else 1.0
        s[COUNTS + i] = w * share * share


@fast_part
def surface_sums(n, s, M, b):
    """Sum what points say of a surface: M (6, 6), its lower triangle, and b (6,)."""
    M[:] = 0.0
    b[:] = 0.0
    for first in range(0, n, CHUNK):
        _surface_sums(min(CHUNK, n - first), s[spot(first) :], M, b)


@fast_part
def _surface_sums(n, s, M, b):
    """Add what a chunk says; products of terms are powers of u and v, of which there are fewer."""
    m00 = m10 = m01 = m20 = m11 = m02 = m30 = m21 = m12 = m03 = 0.0
    m40 = m31 = m22 = m13 = m04 = b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    for i in range(n):
        u, v, w, e = s[FOOT_U + i], s[FOOT_V + i], s[COUNTS + i], s[OFF + i]
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
    for j, value in enumerate((m00, m10, m01, m20, m11, m02)):
        M[j, 0] += value
    for j, value in enumerate((m20, m11, m30, m21, m12)):
        M[1 + j, 1] += value
    for j, value in enumerate((m02, m21, m12, m03)):
        M[2 + j, 2] += value
    for j, value in enumerate((m40, m31, m22)):
        M[3 + j, 3] += value
    M[4, 4] += m22
    M[5, 4] += m13
    M[5, 5] += m04
    for j, value in enumerate((b0, b1, b2, b3, b4, b5)):
        b[j] += value


@part
def _factor(M, L):
    """Cholesky factor of a positive definite (6, 6) matrix; only its lower triangle is read."""
    for i in range(6):
        for j in range(i + 1):
            s = M[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(max(s, 1e-300)) if i == j else s / L[j, j]


@part
def forward(L, b):
    """Solve ``L x = b`` in place."""
    for i in range(6):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]


@part
def backward(L, b):
    """Solve ``L^T x = b`` in place."""
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@part
def firm(M, stiff, L):
    """Factor a surface's normal matrix; a term that no point holds is held by next to nothing."""
    for j in range(6):
        M[j, j] *= 1.0 + 1e-9
        if j > 2:
            M[j, j] += stiff
    _factor(M, L)


@inlined
def by_pose(J, at, s, pivot):
    """Derivative at a foot by a shift and a turn of the frame about its pivot, in patch axes."""
    n1, n2 = s[SLOPE_U + at], s[SLOPE_V + at]
    a0, a1, a2 = s[FOOT_0 + at] - pivot[0], s[FOOT_U + at] - pivot[1], s[FOOT_V + at] - pivot[2]
    J[0], J[1], J[2] = 1.0, n1, n2
    J[3], J[4], J[5] = a1 * n2 - a2 * n1, a2 - a0 * n2, a0 * n1 - a1


@inlined
def by_surface(phi, at, s):
    """Derivative at a foot by the surface's coefficients, its sign turned."""
    u, v = s[FOOT_U + at], s[FOOT_V + at]
    phi[0], phi[1], phi[2] = 1.0, u, v
    phi[3], phi[4], phi[5] = u * u, u * v, v * v


@part
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
