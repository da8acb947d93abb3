"""The passes over the points: residuals and their accumulation into the normal equations.

Equation numbers refer to "Correspondence-Free Multiview Point Cloud Registration via Depth-Guided
Joint Optimisation". The map is read through *nodes*: an (ny, nx, 3) array of height and its nodal
gradient (central differences), both interpolated bilinearly, as the paper does. The state of frame
i is perturbed on the left about a pivot c in the map frame: ``q <- Exp(phi) (q - c) + c + tau``; a
row of the Jacobian is then ``[n, (q - c) x n]`` with the surface normal ``n = (-dD/dx, -dD/dy, 1)``
(eq. JP of the paper, whose Euler angles only parametrise the same step).

All kernels release the GIL, so that threads run one group of frames each; sums inside a group have
a fixed order.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

# Height of the residual's floor: lateral noise of a point, relative to its range noise, squared.
LATERAL = 0.05
# |n.u| below this is a grazing ray: the walk along it is not to be trusted, so its length is
# bounded.
GRAZING = 0.3
# A first step along the ray below this share of a cell needs no second.
SHORT = 0.5


@nb.njit(cache=True, nogil=True)
def nodal_gradients(heights, spacing, nodes):
    """Fill ``nodes`` (ny, nx, 3) with heights and central differences, one-sided at the border."""
    nodal_rows(heights, spacing, nodes, 0, heights.shape[0])


@nb.njit(cache=True, nogil=True)
def nodal_rows(heights, spacing, nodes, first, last):
    """Do what :func:`nodal_gradients` does, for the rows ``first`` to ``last`` alone."""
    ny, nx = heights.shape
    for y in range(first, last):
        y0, y1 = max(y - 1, 0), min(y + 1, ny - 1)
        across, along = 1.0 / ((y1 - y0) * spacing), 0.5 / spacing
        for x in range(1, nx - 1):
            nodes[y, x, 0] = heights[y, x]
            nodes[y, x, 1] = (heights[y, x + 1] - heights[y, x - 1]) * along
            nodes[y, x, 2] = (heights[y1, x] - heights[y0, x]) * across
        for x in (0, nx - 1):
            x0, x1 = max(x - 1, 0), min(x + 1, nx - 1)
            nodes[y, x, 0] = heights[y, x]
            nodes[y, x, 1] = (heights[y, x1] - heights[y, x0]) / ((x1 - x0) * spacing)
            nodes[y, x, 2] = (heights[y1, x] - heights[y0, x]) * across


@nb.njit(cache=True, nogil=True, inline="always")
def _read(nodes, x, y, a, b):
    """Height and gradient at the fraction (a, b) of cell (x, y)."""
    h00, h10, h01, h11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    n00, n10, n01, n11 = nodes[y, x], nodes[y, x + 1], nodes[y + 1, x], nodes[y + 1, x + 1]
    d = h00 * n00[0] + h10 * n10[0] + h01 * n01[0] + h11 * n11[0]
    gx = h00 * n00[1] + h10 * n10[1] + h01 * n01[1] + h11 * n11[1]
    gy = h00 * n00[2] + h10 * n10[2] + h01 * n01[2] + h11 * n11[2]
    return d, gx, gy


@nb.njit(cache=True, nogil=True, inline="always")
def _scalars(R, t, origin, spacing):
    """Rotation, height and grid position of the sensor as scalars, which stay in registers."""
    inverse = 1.0 / spacing
    return (
        R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2],
        t[2], (t[0] - origin[0]) * inverse, (t[1] - origin[1]) * inverse, inverse,
    )  # fmt: skip


@nb.njit(cache=True, nogil=True, inline="always")
def _inside(nodes, bx, by, width, height):
    """First and last cell in x and y on which a footprint and central differences stand."""
    return (
        max(bx, 1), min(bx + width - 2, nodes.shape[1] - 3),
        max(by, 1), min(by + height - 2, nodes.shape[0] - 3),
    )  # fmt: skip


@nb.njit(cache=True, nogil=True, inline="always")
def _residual(px, py, pz, pose, cells, nodes, along_ray, slope, front, cap):
    """Residual of one point.

    Returns: on the map?, cell x, y, fractions a, b, the point (3 values) relative to the sensor's
    centre, residual, squared norm, gx, gy. ``residual / norm`` is the signed distance in metres.
    Along the ray it is taken at the foot, where the viewing ray meets the map (Newton steps; the
    second only where the first was long): a residual read at the noisy point itself correlates with
    the map's gradient there, a bias that grows with its variance.
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22, tz, ox, oy, inverse = pose
    x_low, x_high, y_low, y_high = cells
    qx = r00 * px + r01 * py + r02 * pz
    qy = r10 * px + r11 * py + r12 * pz
    qz = r20 * px + r21 * py + r22 * pz
    cx, cy = qx * inverse + ox, qy * inverse + oy
    # truncation is floor for all that lies on the map
    x, y = int(cx), int(cy)
    on = x >= x_low and y >= y_low and x <= x_high and y <= y_high
    r, norm2, gx, gy = 0.0, 1.0, 0.0, 0.0
    if on:
        d, gx, gy = _read(nodes, x, y, cx - x, cy - y)
        r = qz + tz - d
        if along_ray:
            shorter = 1.0 / np.sqrt(qx * qx + qy * qy + qz * qz)
            ux, uy, uz = qx * shorter, qy * shorter, qz * shorter
            walked = 0.0
            for _ in range(2):
                # a surface seen from behind or at a grazing angle: walk no further than a bounded
                # slope allows
                nu = front * max(front * (uz - gx * ux - gy * uy), GRAZING)
                to = min(max(walked + r / nu, -cap), cap)
                step, walked = to - walked, to
                qx, qy, qz = qx - step * ux, qy - step * uy, qz - step * uz
                cx, cy = qx * inverse + ox, qy * inverse + oy
                x, y = int(cx), int(cy)
                on = x >= x_low and y >= y_low and x <= x_high and y <= y_high
                if not on:
                    break
                d, gx, gy = _read(nodes, x, y, cx - x, cy - y)
                r = qz + tz - d
                if abs(step) * inverse < SHORT:
                    break
            nu = uz - gx * ux - gy * uy
            r += walked * nu
            norm2 = nu * nu + LATERAL * (1.0 + gx * gx + gy * gy)
        elif slope:
            norm2 = 1.0 + gx * gx + gy * gy
    return on, x, y, cx - x, cy - y, qx, qy, qz, r, norm2, gx, gy


@nb.njit(cache=True, nogil=True, fastmath={"contract", "arcp", "reassoc", "nsz"})
def accumulate(
    points, R, t, arm, origin, spacing, nodes, along_ray, slope, front, cap,
    robust_c, judged_c, charge,
    weights, residuals, stencil, A, g, B, bx, by,
):  # fmt: skip
    """Run over a frame's points once and accumulate all of its normal equations.

    A point (of n, 5) is x, y, z in the sensor frame, m, the inverse of its relative noise, and its
    share: a factor on its cost. Adds to the frame's ``A`` (6, 6), ``g`` (6,) and ``B`` (h, w, 6;
    its corner at node (bx, by)) and to the map's ``stencil`` (ny, nx, 6): the node's own term, its
    couplings to x+1, y+1, (x+1, y+1), of x+1 with y+1, and gradient. ``arm`` is the sensor's centre
    relative to the pivot. Writes each point's robust weight and normalised residual (NaN off the
    map). Returns the Geman-McClure cost at scale ``robust_c``, whose weights the equations carry,
    and at ``judged_c`` (0: squares); every point off the map costs ``charge`` there, so that none
    is lost for free; and the points used.
    """
    cost, judged, used = 0.0, 0.0, 0
    c2, j2 = robust_c * robust_c, judged_c * judged_c
    pose = _scalars(R, t, origin, spacing)
    cells = _inside(nodes, bx, by, B.shape[1], B.shape[0])
    arm0, arm1, arm2 = arm[0], arm[1], arm[2]
    # sums in scalars stay in registers: an array would be stored at every point
    a00 = a10 = a11 = a20 = a21 = a22 = a30 = a31 = a32 = a33 = 0.0
    a40 = a41 = a42 = a43 = a44 = a50 = a51 = a52 = a53 = a54 = a55 = 0.0
    g0 = g1 = g2 = g3 = g4 = g5 = 0.0
    for k in range(points.shape[0]):
        own, share = np.float64(points[k, 3]), np.float64(points[k, 4])
        on, x, y, a, b, qx, qy, qz, r, norm2, gx, gy = _residual(
            np.float64(points[k, 0]), np.float64(points[k, 1]), np.float64(points[k, 2]), pose,
            cells, nodes, along_ray, slope, front, cap,
        )  # fmt: skip
        if not on or share <= 0.0:
            cost += share * charge
            judged += share * charge
            weights[k] = 0.0
            residuals[k] = np.nan
            continue
        scale2 = own * own / norm2
        e2 = r * r * scale2
        psi = 1.0
        if c2 > 0.0:
            root = c2 / (c2 + e2)
            psi = root * root
            cost += share * root * e2
        else:
            cost += share * e2
        if j2 != c2:
            judged += share * (e2 * j2 / (j2 + e2) if j2 > 0.0 else e2)
        used += 1
        weights[k] = psi
        residuals[k] = r * np.sqrt(scale2)
        w = share * psi * scale2
        lx, ly, lz = qx + arm0, qy + arm1, qz + arm2
        j3, j4, j5 = ly + lz * gy, -lz * gx - lx, -lx * gy + ly * gx
        w0, w1, w3, w4, w5 = -w * gx, -w * gy, w * j3, w * j4, w * j5
        a00 -= w0 * gx
        a10 -= w1 * gx
        a11 -= w1 * gy
        a20 += w0
        a21 += w1
        a22 += w
        a30 -= w3 * gx
        a31 -= w3 * gy
        a32 += w3
        a33 += w3 * j3
        a40 -= w4 * gx
        a41 -= w4 * gy
        a42 += w4
        a43 += w4 * j3
        a44 += w4 * j4
        a50 -= w5 * gx
        a51 -= w5 * gy
        a52 += w5
        a53 += w5 * j3
        a54 += w5 * j4
        a55 += w5 * j5
        g0 += w0 * r
        g1 += w1 * r
        g2 += w * r
        g3 += w3 * r
        g4 += w4 * r
        g5 += w5 * r
        h00, h10, h01, h11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        _couple(B[y - by, x - bx], h00, w0, w1, w, w3, w4, w5)
        _couple(B[y - by, x + 1 - bx], h10, w0, w1, w, w3, w4, w5)
        _couple(B[y + 1 - by, x - bx], h01, w0, w1, w, w3, w4, w5)
        _couple(B[y + 1 - by, x + 1 - bx], h11, w0, w1, w, w3, w4, w5)
        v00, v10, v01, v11 = w * h00, w * h10, w * h01, w * h11
        node = stencil[y, x]
        node[0] += v00 * h00
        node[1] += v00 * h10
        node[2] += v00 * h01
        node[3] += v00 * h11
        node[4] += v10 * h01
        node[5] -= v00 * r
        node = stencil[y, x + 1]
        node[0] += v10 * h10
        node[2] += v10 * h11
        node[5] -= v10 * r
        node = stencil[y + 1, x]
        node[0] += v01 * h01
        node[1] += v01 * h11
        node[5] -= v01 * r
        node = stencil[y + 1, x + 1]
        node[0] += v11 * h11
        node[5] -= v11 * r
    rows = (
        (a00, a10, a20, a30, a40, a50), (a10, a11, a21, a31, a41, a51),
        (a20, a21, a22, a32, a42, a52), (a30, a31, a32, a33, a43, a53),
        (a40, a41, a42, a43, a44, a54), (a50, a51, a52, a53, a54, a55),
    )  # fmt: skip
    sums = (g0, g1, g2, g3, g4, g5)
    for m in range(6):
        g[m] += sums[m]
        for n in range(6):
            A[m, n] += rows[m][n]
    return cost, (cost if j2 == c2 else judged), used


@nb.njit(cache=True, nogil=True)
def collect(
    totals, heights, smooth, weight, first, last, own, right, up, up_right, up_left, gradient
):  # fmt: skip
    """Sum the stencils ``totals`` (parts, ny, nx, 6) over some rows.

    Rows ``first`` to ``last``. Adds the smoothing term, ``weight`` times the squared difference of
    neighbouring heights where both are ``smooth``, and returns its cost. Nodes that nothing touches
    stay what they are: they get a diagonal of 1.
    """
    ny, nx = heights.shape
    cost = 0.0
    for y in range(first, last):
        for x in range(nx):
            o, r, u, d, a, g = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(totals.shape[0]):
                node = totals[k, y, x]
                o += node[0]
                r += node[1]
                u += node[2]
                d += node[3]
                a += node[4]
                g += node[5]
            if smooth[y, x]:
                if x + 1 < nx and smooth[y, x + 1]:
                    e = heights[y, x] - heights[y, x + 1]
                    o += weight
                    r -= weight
                    g += weight * e
                    cost += weight * e * e
                if y + 1 < ny and smooth[y + 1, x]:
                    e = heights[y, x] - heights[y + 1, x]
                    o += weight
                    u -= weight
                    g += weight * e
                    cost += weight * e * e
                if x > 0 and smooth[y, x - 1]:
                    o += weight
                    g += weight * (heights[y, x] - heights[y, x - 1])
                if y > 0 and smooth[y - 1, x]:
                    o += weight
                    g += weight * (heights[y, x] - heights[y - 1, x])
            own[y, x] = o if o > 0.0 else 1.0
            right[y, x] = r
            up[y, x] = u
            up_right[y, x] = d
            up_left[y, x] = a
            gradient[y, x] = g
    return cost


@nb.njit(cache=True, nogil=True, inline="always")
def _couple(node, h, w0, w1, w2, w3, w4, w5):
    """Subtract a point's weighted Jacobian, times its share ``h`` of a node, from the coupling."""
    node[0] -= h * w0
    node[1] -= h * w1
    node[2] -= h * w2
    node[3] -= h * w3
    node[4] -= h * w4
    node[5] -= h * w5


@nb.njit(cache=True, nogil=True, inline="always")
def _apart(field, x, y, a, b, value):
    """Subtract a value from the four nodes of a cell by their shares."""
    field[y, x] -= (1 - a) * (1 - b) * value
    field[y, x + 1] -= a * (1 - b) * value
    field[y + 1, x] -= (1 - a) * b * value
    field[y + 1, x + 1] -= a * b * value


@nb.njit(cache=True, nogil=True)
def contributions(
    points, R, t, arm, origin, spacing, nodes, along_ray, slope, front, cap, weights, groups,
    cells_of, shares, scores,
):  # fmt: skip
    """Write where every point lands and what it adds to the gradients.

    ``cells_of`` (n, 2) gets its cell (-1 where it does not count), ``shares`` (n, 3) its fractions
    in the cell and its weighted residual. What it adds to the frame's own gradient goes to
    ``scores`` (kinds, groups, 6), by its group in each row of ``groups`` (kinds, n).
    """
    pose = _scalars(R, t, origin, spacing)
    cells = _inside(nodes, 0, 0, nodes.shape[1], nodes.shape[0])
    for k in range(points.shape[0]):
        cells_of[k, 0] = -1
        if weights[k] <= 0.0:
            continue
        on, x, y, a, b, qx, qy, qz, r, norm2, gx, gy = _residual(
            np.float64(points[k, 0]), np.float64(points[k, 1]), np.float64(points[k, 2]), pose,
            cells, nodes, along_ray, slope, front, cap,
        )  # fmt: skip
        if not on:
            continue
        wr = points[k, 4] * weights[k] * np.float64(points[k, 3]) ** 2 / norm2 * r
        cells_of[k, 0], cells_of[k, 1] = x, y
        shares[k, 0], shares[k, 1], shares[k, 2] = a, b, wr
        lx, ly, lz = qx + arm[0], qy + arm[1], qz + arm[2]
        for kind in range(groups.shape[0]):
            s = scores[kind, groups[kind, k]]
            s[0] -= wr * gx
            s[1] -= wr * gy
            s[2] += wr
            s[3] += wr * (ly + lz * gy)
            s[4] += wr * (-lz * gx - lx)
            s[5] += wr * (-lx * gy + ly * gx)


@nb.njit(cache=True, nogil=True)
def answered(cells_of, shares, groups, answer, left, low, scores):
    """Add what the map's answer makes of the points' contributions to another frame's ``scores``.

    ``answer`` (h, w, 6) is that frame's ``C^-1 B^T`` over the window from node (left, low) on; the
    rest is as :func:`contributions` wrote it.
    """
    height, width = answer.shape[0], answer.shape[1]
    for k in range(cells_of.shape[0]):
        x, y = cells_of[k, 0] - left, cells_of[k, 1] - low
        if cells_of[k, 0] < 0 or x < 0 or y < 0 or x + 1 >= width or y + 1 >= height:
            continue
        a, b, wr = shares[k, 0], shares[k, 1], shares[k, 2]
        h00, h10 = wr * (1 - a) * (1 - b), wr * a * (1 - b)
        h01, h11 = wr * (1 - a) * b, wr * a * b
        n00, n10, n01, n11 = answer[y, x], answer[y, x + 1], answer[y + 1, x], answer[y + 1, x + 1]
        for m in range(6):
            v = h00 * n00[m] + h10 * n10[m] + h01 * n01[m] + h11 * n11[m]
            for kind in range(groups.shape[0]):
                scores[kind, groups[kind, k], m] += v


@nb.njit(cache=True, nogil=True)
def noise_gradient(
    points, R, t, origin, spacing, nodes, along_ray, slope, front, cap, weights, draws, gradient,
):  # fmt: skip
    """Add to ``gradient`` (ny, nx) what residuals ``draws`` (n,) times the points' sigma would."""
    pose = _scalars(R, t, origin, spacing)
    cells = _inside(nodes, 0, 0, nodes.shape[1], nodes.shape[0])
    for k in range(points.shape[0]):
        if weights[k] <= 0.0:
            continue
        on, x, y, a, b, _, _, _, _, norm2, _, _ = _residual(
            np.float64(points[k, 0]), np.float64(points[k, 1]), np.float64(points[k, 2]), pose,
            cells, nodes, along_ray, slope, front, cap,
        )  # fmt: skip
        if not on:
            continue
        e = points[k, 4] * weights[k] * points[k, 3] / np.sqrt(norm2) * draws[k]
        _apart(gradient, x, y, a, b, e)


@nb.njit(cache=True, nogil=True)
def slope_noise(
    points, R, t, arm, origin, spacing, nodes, along_ray, slope, front, cap,
    weights, noise, A, B, bx, by,
):  # fmt: skip
    """Accumulate ``A`` (6, 6) and ``B`` (h, w, 6) of Jacobians that hold slope noise alone.

    ``noise`` (ny, nx, 3) are nodes of a map that is nothing but noise; the rest is as for
    :func:`accumulate`. Only the lower triangle of ``A`` is filled.
    """
    j = np.zeros(6)
    pose = _scalars(R, t, origin, spacing)
    cells = _inside(nodes, bx, by, B.shape[1], B.shape[0])
    for k in range(points.shape[0]):
        if weights[k] <= 0.0:
            continue
        on, x, y, a, b, qx, qy, qz, _, norm2, _, _ = _residual(
            np.float64(points[k, 0]), np.float64(points[k, 1]), np.float64(points[k, 2]), pose,
            cells, nodes, along_ray, slope, front, cap,
        )  # fmt: skip
        if not on:
            continue
        w = points[k, 4] * weights[k] * np.float64(points[k, 3]) ** 2 / norm2
        _, gx, gy = _read(noise, x, y, a, b)
        lx, ly, lz = qx + arm[0], qy + arm[1], qz + arm[2]
        j[0], j[1], j[2] = -gx, -gy, 0.0
        j[3], j[4], j[5] = lz * gy, -lz * gx, -lx * gy + ly * gx
        for m in range(6):
            for n in range(m + 1):
                A[m, n] += w * j[m] * j[n]
        h00, h10, h01, h11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        w0, w1, w3, w4, w5 = w * j[0], w * j[1], w * j[3], w * j[4], w * j[5]
        _couple(B[y - by, x - bx], h00, w0, w1, 0.0, w3, w4, w5)
        _couple(B[y - by, x + 1 - bx], h10, w0, w1, 0.0, w3, w4, w5)
        _couple(B[y + 1 - by, x - bx], h01, w0, w1, 0.0, w3, w4, w5)
        _couple(B[y + 1 - by, x + 1 - bx], h11, w0, w1, 0.0, w3, w4, w5)


@nb.njit(cache=True, nogil=True)
def leverages(
    points, stride, R, t, origin, spacing, nodes, along_ray, slope, front, cap, weights, own, out,
):  # fmt: skip
    """Write to ``out`` (k,) how much every ``stride``-th point pulls the map to itself.

    0: not at all, 1: the map follows it. ``own`` (ny, nx) is the map's diagonal, which is right on
    average over evenly spread points. NaN off the map.
    """
    pose = _scalars(R, t, origin, spacing)
    cells = _inside(nodes, 0, 0, nodes.shape[1], nodes.shape[0])
    for i in range(out.shape[0]):
        k = i * stride
        out[i] = np.nan
        if weights[k] <= 0.0:
            continue
        on, x, y, a, b, _, _, _, _, norm2, _, _ = _residual(
            np.float64(points[k, 0]), np.float64(points[k, 1]), np.float64(points[k, 2]), pose,
            cells, nodes, along_ray, slope, front, cap,
        )  # fmt: skip
        if on:
            h00, h10, h01, h11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
            out[i] = points[k, 4] * weights[k] * np.float64(points[k, 3]) ** 2 / norm2 * (
                h00 * h00 / own[y, x] + h10 * h10 / own[y, x + 1]
                + h01 * h01 / own[y + 1, x] + h11 * h11 / own[y + 1, x + 1]
            )  # fmt: skip


@nb.njit(cache=True, nogil=True)
def splat(points, R, t, origin, spacing, total, count):
    """Add the points' heights to the nodes nearest to them: their sum and number, each (ny, nx)."""
    ny, nx = total.shape
    for k in range(points.shape[0]):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        qx = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
        qy = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
        qz = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
        x = int(np.floor((qx - origin[0]) / spacing + 0.5))
        y = int(np.floor((qy - origin[1]) / spacing + 0.5))
        if 0 <= x < nx and 0 <= y < ny:
            total[y, x] += qz
            count[y, x] += 1.0


@nb.njit(cache=True, nogil=True)
def splat_residuals(points, R, t, origin, spacing, nodes, total, squares, count):
    """Add the points' vertical distances from the map to the nodes nearest to them.

    Sum, squares and number.
    """
    ny, nx = total.shape
    for k in range(points.shape[0]):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        cx = (R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0] - origin[0]) / spacing
        cy = (R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1] - origin[1]) / spacing
        x, y = int(np.floor(cx)), int(np.floor(cy))
        if x < 1 or y < 1 or x >= nx - 2 or y >= ny - 2:
            continue
        height = _read(nodes, x, y, cx - x, cy - y)[0]
        r = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2] - height
        x, y = int(np.floor(cx + 0.5)), int(np.floor(cy + 0.5))
        total[y, x] += r
        squares[y, x] += r * r
        count[y, x] += 1.0
