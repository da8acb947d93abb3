"""The pass over the points: where each meets the map, and what it adds to the normal equations.

Equation numbers refer to "Correspondence-Free Multiview Point Cloud Registration via Depth-Guided
Joint Optimisation". The map is read through *nodes*: an (ny, nx, 3) array of height and its nodal
gradient (central differences), both interpolated bilinearly, as the paper does. The state of frame
i is perturbed on the left about a pivot c in the map frame: ``q <- Exp(phi) (q - c) + c + tau``; a
row of the Jacobian is then ``[n, (q - c) x n]`` with the surface normal ``n = (-dD/dx, -dD/dy, 1)``
(eq. JP of the paper, whose Euler angles only parametrise the same step).

A residual is a chain of dependent loads, divisions and roots: point by point the processor waits
for each. So points go through in chunks, one stage for the whole chunk after the other, which the
compiler turns into vector instructions. Sums have a fixed order. All kernels release the GIL.
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
# Points that go through together: their rows stay in the first-level cache.
CHUNK = 128
# Rows of a chunk: fractions in the cell; the point relative to the sensor's centre; residual and
# its squared norm; the map's gradient and height; 1 on the map, else 0; distance walked.
FRACTION_X, FRACTION_Y, ARM_X, ARM_Y, ARM_Z, RESIDUAL, NORM2 = 0, 1, 2, 3, 4, 5, 6
SLOPE_X, SLOPE_Y, ON, HEIGHT, WALKED = 7, 8, 9, 10, 11
ROWS = 12

# sums may be reordered and products fused, but NaN and infinity stay what they are
FAST = {"contract", "arcp", "reassoc", "nsz"}


@nb.njit(cache=True, nogil=True)
def _pose(R, t, origin, spacing):
    """Rotation, height and grid position of the sensor, and the inverse spacing, as scalars."""
    inverse = 1.0 / spacing
    return (
        R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2],
        t[2], (t[0] - origin[0]) * inverse, (t[1] - origin[1]) * inverse, inverse,
    )  # fmt: skip


@nb.njit(cache=True, nogil=True)
def _inside(nodes, bx, by, width, height):
    """Lower and upper bounds in x and y of the cells with central differences in a window."""
    return (
        float(max(bx, 1)), float(min(bx + width - 1, nodes.shape[1] - 2)),
        float(max(by, 1)), float(min(by + height - 1, nodes.shape[0] - 2)),
    )  # fmt: skip


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _place(points, pose, s):
    """Rotate the points into the map frame; their grid positions go where fractions will be."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, _, ox, oy, inverse = pose
    cx, cy, qx, qy, qz = s[FRACTION_X], s[FRACTION_Y], s[ARM_X], s[ARM_Y], s[ARM_Z]
    for k in range(points.shape[0]):
        px, py, pz = np.float64(points[k, 0]), np.float64(points[k, 1]), np.float64(points[k, 2])
        x = r00 * px + r01 * py + r02 * pz
        y = r10 * px + r11 * py + r12 * pz
        qx[k] = x
        qy[k] = y
        qz[k] = r20 * px + r21 * py + r22 * pz
        cx[k] = x * inverse + ox
        cy[k] = y * inverse + oy


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _settle(n, bounds, s, cells):
    """Split grid positions into cells and fractions; what is off the map is put into its corner."""
    x_low, x_high, y_low, y_high = bounds
    cx, cy, on = s[FRACTION_X], s[FRACTION_Y], s[ON]
    us, vs = cells[0], cells[1]
    for k in range(n):
        x, y = cx[k], cy[k]
        inside = (x >= x_low) & (x < x_high) & (y >= y_low) & (y < y_high)
        x, y = x if inside else x_low, y if inside else y_low
        # truncation is floor for all that lies on the map
        u, v = np.int32(x), np.int32(y)
        us[k], vs[k] = u, v
        cx[k], cy[k] = x - u, y - v
        on[k] = on[k] if inside else 0.0


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _look(n, nodes, s, cells):
    """Read height and gradient."""
    fx, fy, d, gx, gy = s[FRACTION_X], s[FRACTION_Y], s[HEIGHT], s[SLOPE_X], s[SLOPE_Y]
    us, vs = cells[0], cells[1]
    for k in range(n):
        # unsigned: no index counts from the end
        x, y = np.uint32(us[k]), np.uint32(vs[k])
        a, b = fx[k], fy[k]
        h00, h10, h01, h11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        n00, n10 = nodes[y, x], nodes[y, x + np.uint32(1)]
        n01, n11 = nodes[y + np.uint32(1), x], nodes[y + np.uint32(1), x + np.uint32(1)]
        d[k] = h00 * n00[0] + h10 * n10[0] + h01 * n01[0] + h11 * n11[0]
        gx[k] = h00 * n00[1] + h10 * n10[1] + h01 * n01[1] + h11 * n11[1]
        gy[k] = h00 * n00[2] + h10 * n10[2] + h01 * n01[2] + h11 * n11[2]


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _walk(n, pose, front, cap, s):
    """Take a Newton step along the viewing ray to where it meets the map.

    A surface seen from behind or at a grazing angle: walk no further than a bounded slope allows.
    """
    tz, ox, oy, inverse = pose[9], pose[10], pose[11], pose[12]
    cx, cy, qx, qy, qz = s[FRACTION_X], s[FRACTION_Y], s[ARM_X], s[ARM_Y], s[ARM_Z]
    d, gx, gy, walked = s[HEIGHT], s[SLOPE_X], s[SLOPE_Y], s[WALKED]
    for k in range(n):
        x, y, z = qx[k], qy[k], qz[k]
        shorter = 1.0 / np.sqrt(x * x + y * y + z * z)
        facing = front * shorter * (z - gx[k] * x - gy[k] * y)
        nu = front * (facing if facing > GRAZING else GRAZING)
        to = walked[k] + (z * (1.0 - walked[k] * shorter) + tz - d[k]) / nu
        to = to if to < cap else cap
        to = to if to > -cap else -cap
        walked[k] = to
        scale = (1.0 - to * shorter) * inverse
        cx[k] = x * scale + ox
        cy[k] = y * scale + oy


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _measure_along(n, tz, s):
    """Take the residual at the foot of the ray: the distance walked."""
    qx, qy, qz, r, norm2 = s[ARM_X], s[ARM_Y], s[ARM_Z], s[RESIDUAL], s[NORM2]
    d, gx, gy, walked = s[HEIGHT], s[SLOPE_X], s[SLOPE_Y], s[WALKED]
    for k in range(n):
        x, y, z = qx[k], qy[k], qz[k]
        shorter = 1.0 / np.sqrt(x * x + y * y + z * z)
        nu = shorter * (z - gx[k] * x - gy[k] * y)
        scale = 1.0 - walked[k] * shorter
        qx[k], qy[k], qz[k] = x * scale, y * scale, z * scale
        r[k] = z * scale + tz - d[k] + walked[k] * nu
        norm2[k] = nu * nu + LATERAL * (1.0 + gx[k] * gx[k] + gy[k] * gy[k])


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _measure_upright(n, tz, slope, s):
    """Take the vertical residual, weighed down on slopes if asked."""
    qz, r, norm2 = s[ARM_Z], s[RESIDUAL], s[NORM2]
    d, gx, gy = s[HEIGHT], s[SLOPE_X], s[SLOPE_Y]
    steep = 1.0 if slope else 0.0
    for k in range(n):
        r[k] = qz[k] + tz - d[k]
        norm2[k] = 1.0 + steep * (gx[k] * gx[k] + gy[k] * gy[k])


@nb.njit(cache=True, nogil=True)
def _walk_on(n, pose, bounds, nodes, front, cap, s, cells, far, far_cells):
    """Take the second step for the points whose first was long."""
    count = 0
    reach = SHORT / pose[12]
    for k in range(n):
        if s[ON, k] > 0.0 and abs(s[WALKED, k]) >= reach:
            for row in range(ROWS):
                far[row, count] = s[row, k]
            far_cells[2, count] = k
            count += 1
    if count == 0:
        return
    _walk(count, pose, front, cap, far)
    _settle(count, bounds, far, far_cells)
    _look(count, nodes, far, far_cells)
    for i in range(count):
        k = far_cells[2, i]
        for row in range(ROWS):
            s[row, k] = far[row, i]
        cells[0, k], cells[1, k] = far_cells[0, i], far_cells[1, i]


@nb.njit(cache=True, nogil=True)
def _land(
    points, pose, bounds, nodes, along_ray, slope, front, cap, s, cells, far, far_cells
):  # fmt: skip
    """Fill the rows ``s`` (ROWS, n) and the ``cells`` (2, n) of a chunk of points.

    Along the ray a residual is taken at the foot, where the viewing ray meets the map (Newton
    steps; the second only where the first was long): read at the noisy point itself it correlates
    with the map's gradient there, a bias that grows with its variance. ``residual / sqrt(norm2)``
    is the signed distance in metres.
    """
    n = points.shape[0]
    s[ON, :n] = 1.0
    _place(points, pose, s)
    _settle(n, bounds, s, cells)
    _look(n, nodes, s, cells)
    if along_ray:
        s[WALKED, :n] = 0.0
        _walk(n, pose, front, cap, s)
        _settle(n, bounds, s, cells)
        _look(n, nodes, s, cells)
        _walk_on(n, pose, bounds, nodes, front, cap, s, cells, far, far_cells)
        _measure_along(n, pose[9], s)
    else:
        _measure_upright(n, pose[9], slope, s)


@nb.njit(cache=True, nogil=True)
def feet(points, R, t, origin, spacing, nodes, along_ray, slope, front, cap, rows, cells):
    """Fill ``rows`` (ROWS, n) and ``cells`` (2, n), x and y, with where a frame meets the map."""
    pose = _pose(R, t, origin, spacing)
    bounds = _inside(nodes, 0, 0, nodes.shape[1], nodes.shape[0])
    far, far_cells = np.empty((ROWS, CHUNK)), np.empty((3, CHUNK), np.int32)
    for first in range(0, points.shape[0], CHUNK):
        last = min(first + CHUNK, points.shape[0])
        _land(
            points[first:last], pose, bounds, nodes, along_ray, slope, front, cap,
            rows[:, first:last], cells[:, first:last], far, far_cells,
        )  # fmt: skip


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _weigh(inverse_noise, shares, c2, s, w, weights, residuals):
    """Give every point its robust weight and normalised residual; ``w`` is its whole weight."""
    r, norm2, on = s[RESIDUAL], s[NORM2], s[ON]
    for k in range(shares.shape[0]):
        own, share = np.float64(inverse_noise[k]), np.float64(shares[k])
        counts = on[k] if share > 0.0 else 0.0
        on[k] = counts
        scale2 = own * own / norm2[k]
        root = c2 / (c2 + r[k] * r[k] * scale2) if c2 > 0.0 else 1.0
        psi = root * root * counts
        weights[k] = psi
        residuals[k] = r[k] * np.sqrt(scale2) if counts > 0.0 else np.nan
        w[k] = share * psi * scale2


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _cost(inverse_noise, shares, c2, charge, s):
    """Geman-McClure cost of a chunk at the squared scale ``c2``; 0: squares."""
    r, norm2, on = s[RESIDUAL], s[NORM2], s[ON]
    cost = 0.0
    for k in range(shares.shape[0]):
        own, share = np.float64(inverse_noise[k]), np.float64(shares[k])
        e2 = r[k] * r[k] * own * own / norm2[k]
        e2 = c2 / (c2 + e2) * e2 if c2 > 0.0 else e2
        cost += share * (on[k] * e2 + (1.0 - on[k]) * charge)
    return cost


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _differentiate(n, arm, s, w, J, wJ):
    """Fill the Jacobian's columns (6, n) and those times the weights."""
    ax, ay, az = arm[0], arm[1], arm[2]
    qx, qy, qz, gx, gy = s[ARM_X], s[ARM_Y], s[ARM_Z], s[SLOPE_X], s[SLOPE_Y]
    for k in range(n):
        J[0, k] = -gx[k]
        J[1, k] = -gy[k]
        J[2, k] = 1.0
    for k in range(n):
        lx, ly, lz = qx[k] + ax, qy[k] + ay, qz[k] + az
        J[3, k] = ly + lz * gy[k]
        J[4, k] = -lz * gx[k] - lx
        J[5, k] = -lx * gy[k] + ly * gx[k]
    for m in range(6):
        for k in range(n):
            wJ[m, k] = w[k] * J[m, k]


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _sum(n, r, J, wJ, A, g):
    """Add the chunk's products of columns to the lower triangle of ``A`` and to ``g``."""
    for m in range(6):
        left = wJ[m]
        total = 0.0
        for k in range(n):
            total += left[k] * r[k]
        g[m] += total
        for j in range(m + 1):
            right = J[j]
            total = 0.0
            for k in range(n):
                total += left[k] * right[k]
            A[m, j] += total


@nb.njit(cache=True, nogil=True, inline="always")
def _couple(node, h, w0, w1, w2, w3, w4, w5):
    """Subtract a point's weighted Jacobian, times its share ``h`` of a node, from the coupling."""
    node[0] -= h * w0
    node[1] -= h * w1
    node[2] -= h * w2
    node[3] -= h * w3
    node[4] -= h * w4
    node[5] -= h * w5


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _scatter(n, s, cells, w, wJ, B, bx, by, stencil):
    """Add the chunk's couplings with the map and the map's own terms, node by node."""
    fx, fy, r = s[FRACTION_X], s[FRACTION_Y], s[RESIDUAL]
    left, low = np.int32(bx), np.int32(by)
    one = np.uint32(1)
    for k in range(n):
        v = w[k]
        if v == 0.0:
            continue
        a, b = fx[k], fy[k]
        h00, h10, h01, h11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        w0, w1, w2, w3, w4, w5 = wJ[0, k], wJ[1, k], wJ[2, k], wJ[3, k], wJ[4, k], wJ[5, k]
        x, y = np.uint32(cells[0, k] - left), np.uint32(cells[1, k] - low)
        _couple(B[y, x], h00, w0, w1, w2, w3, w4, w5)
        _couple(B[y, x + one], h10, w0, w1, w2, w3, w4, w5)
        _couple(B[y + one, x], h01, w0, w1, w2, w3, w4, w5)
        _couple(B[y + one, x + one], h11, w0, w1, w2, w3, w4, w5)
        v00, v10, v01, v11 = v * h00, v * h10, v * h01, v * h11
        x, y = np.uint32(cells[0, k]), np.uint32(cells[1, k])
        node = stencil[y, x]
        node[0] += v00 * h00
        node[1] += v00 * h10
        node[2] += v00 * h01
        node[3] += v00 * h11
        node[4] += v10 * h01
        node[5] -= v00 * r[k]
        node = stencil[y, x + one]
        node[0] += v10 * h10
        node[2] += v10 * h11
        node[5] -= v10 * r[k]
        node = stencil[y + one, x]
        node[0] += v01 * h01
        node[1] += v01 * h11
        node[5] -= v01 * r[k]
        node = stencil[y + one, x + one]
        node[0] += v11 * h11
        node[5] -= v11 * r[k]


@nb.njit(cache=True, nogil=True)
def accumulate(
    points, inverse_noise, shares, R, t, arm, origin, spacing, nodes, along_ray, slope, front, cap,
    robust_c, judged_c, charge,
    weights, residuals, stencil, A, g, B, bx, by,
):  # fmt: skip
    """Run over a frame's points once and accumulate all of its normal equations.

    With each point, (n, 3) in the sensor frame, m, go the inverse of its relative noise and its
    share, a factor on its cost. Adds to the frame's ``A`` (6, 6), ``g`` (6,) and ``B`` (h, w, 6;
    its corner at node (bx, by)) and to the map's ``stencil`` (ny, nx, 6): the node's own term, its
    couplings to x+1, y+1, (x+1, y+1), of x+1 with y+1, and gradient. ``arm`` is the sensor's centre
    relative to the pivot. Writes each point's robust weight and normalised residual (NaN off the
    map). Returns the Geman-McClure cost at scale ``robust_c``, whose weights the equations carry,
    and at ``judged_c`` (0: squares); every point off the map costs ``charge`` there, so that none
    is lost for free; and the points used.
    """
    cost, judged, used = 0.0, 0.0, 0.0
    c2, j2 = robust_c * robust_c, judged_c * judged_c
    pose = _pose(R, t, origin, spacing)
    bounds = _inside(nodes, bx, by, B.shape[1], B.shape[0])
    s, cells = np.empty((ROWS, CHUNK)), np.empty((2, CHUNK), np.int32)
    far, far_cells = np.empty((ROWS, CHUNK)), np.empty((3, CHUNK), np.int32)
    w, J, wJ = np.empty(CHUNK), np.empty((6, CHUNK)), np.empty((6, CHUNK))
    block = np.zeros((6, 6))
    for first in range(0, points.shape[0], CHUNK):
        last = min(first + CHUNK, points.shape[0])
        own, share, n = inverse_noise[first:last], shares[first:last], last - first
        _land(
            points[first:last], pose, bounds, nodes, along_ray, slope, front, cap, s, cells, far,
            far_cells,
        )  # fmt: skip
        _weigh(own, share, c2, s, w, weights[first:last], residuals[first:last])
        part = _cost(own, share, c2, charge, s)
        cost += part
        judged += part if j2 == c2 else _cost(own, share, j2, charge, s)
        used += s[ON, :n].sum()
        _differentiate(n, arm, s, w, J, wJ)
        _sum(n, s[RESIDUAL], J, wJ, block, g)
        _scatter(n, s, cells, w, wJ, B, bx, by, stencil)
    for m in range(6):
        for j in range(6):
            A[m, j] += block[max(m, j), min(m, j)]
    return cost, judged, used
