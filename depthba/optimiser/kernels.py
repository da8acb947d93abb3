"""The pass over the points: where each meets the map, and what it adds to the normal equations.

Equation numbers refer to "Correspondence-Free Multiview Point Cloud Registration via Depth-Guided
Joint Optimisation". The map is read through *nodes*: an (ny, nx, 3) array of height and its nodal
gradient (central differences), both interpolated bilinearly, as the paper does. The state of frame
i is perturbed on the left about a pivot c in the map frame: ``q <- Exp(phi) (q - c) + c + tau``; a
row of the Jacobian is then ``[n, (q - c) x n]`` with the surface normal ``n = (-dD/dx, -dD/dy, 1)``
(eq. JP of the paper, whose Euler angles only parametrise the same step).

A residual is a chain of dependent loads, divisions and roots: point by point the processor waits
for each. So points go through in chunks, one stage for the whole chunk after the other, which the
compiler turns into vector instructions. Rows of a chunk begin at constant places of one flat array:
between arrays of their own it would have to check at run time whether they overlap, and does not.
Sums have a fixed order. All kernels release the GIL.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numpy as np

from depthba.compiling import fast_part, inlined, kernel, part

# Height of the residual's floor: lateral noise of a point, relative to its range noise, squared.
LATERAL = 0.05
# |n.u| below this is a grazing ray: the walk along it is not to be trusted, so its length is
# bounded.
GRAZING = 0.3
# A first step along the ray below this share of a cell needs no second.
SHORT = 0.5
# Least squared length of a ray, m^2: that of a point in the sensor's centre is not nothing.
TINY = 1e-200
# Points that go through together: their rows stay in the first-level cache.
CHUNK = 128
# Where the rows of a chunk begin. Of a point that lands: fractions in the cell; the point relative
# to the sensor's centre; residual and its squared norm; the map's gradient and height; 1 on the
# map, else 0; distance walked.
FRACTION_X, FRACTION_Y, ARM_X, ARM_Y, ARM_Z, RESIDUAL = range(0, 6 * CHUNK, CHUNK)
NORM2, SLOPE_X, SLOPE_Y, ON, HEIGHT, WALKED = range(6 * CHUNK, 12 * CHUNK, CHUNK)
ROWS = 12
# Its whole weight; then columns of the Jacobian, and those times the weight, six rows each.
WEIGHT, JACOBIAN, WEIGHED = 12 * CHUNK, 13 * CHUNK, 19 * CHUNK
ALL = 25 * CHUNK
# Of cells: their place; of the points that walk on: which they are.
CELL_X, CELL_Y, WHICH = 0, CHUNK, 2 * CHUNK


@part
def _pose(R, t, origin, spacing):
    """Rotation, height and grid position of the sensor, and the inverse spacing, as scalars."""
    inverse = 1.0 / spacing
    return (
        R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2],
        t[2], (t[0] - origin[0]) * inverse, (t[1] - origin[1]) * inverse, inverse,
    )  # fmt: skip


@part
def _inside(nodes, bx, by, width, height):
    """Lower and upper bounds in x and y of the cells with central differences in a window."""
    return (
        float(max(bx, 1)), float(min(bx + width - 1, nodes.shape[1] - 2)),
        float(max(by, 1)), float(min(by + height - 1, nodes.shape[0] - 2)),
    )  # fmt: skip


@fast_part
def _place(points, pose, s):
    """Rotate the points into the map frame; their grid positions go where fractions will be."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, _, ox, oy, inverse = pose
    for k in range(points.shape[0]):
        px, py, pz = np.float64(points[k, 0]), np.float64(points[k, 1]), np.float64(points[k, 2])
        x = r00 * px + r01 * py + r02 * pz
        y = r10 * px + r11 * py + r12 * pz
        s[ARM_X + k] = x
        s[ARM_Y + k] = y
        s[ARM_Z + k] = r20 * px + r21 * py + r22 * pz
        s[FRACTION_X + k] = x * inverse + ox
        s[FRACTION_Y + k] = y * inverse + oy


@fast_part
def _settle(n, bounds, s, cells):
    """Split grid positions into cells and fractions; what is off the map is put into its corner."""
    x_low, x_high, y_low, y_high = bounds
    for k in range(n):
        x, y = s[FRACTION_X + k], s[FRACTION_Y + k]
        inside = (x >= x_low) & (x < x_high) & (y >= y_low) & (y < y_high)
        x, y = x if inside else x_low, y if inside else y_low
        # truncation is floor for all that lies on the map
        u, v = np.int32(x), np.int32(y)
        cells[CELL_X + k], cells[CELL_Y + k] = u, v
        s[FRACTION_X + k], s[FRACTION_Y + k] = x - u, y - v
        s[ON + k] = s[ON + k] if inside else 0.0


@fast_part
def _look(n, nodes, s, cells):
    """Read height and gradient."""
    for k in range(n):
        # unsigned: no index counts from the end
        x, y = np.uint32(cells[CELL_X + k]), np.uint32(cells[CELL_Y + k])
        a, b = s[FRACTION_X + k], s[FRACTION_Y + k]
        h00, h10, h01, h11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        n00, n10 = nodes[y, x], nodes[y, x + np.uint32(1)]
        n01, n11 = nodes[y + np.uint32(1), x], nodes[y + np.uint32(1), x + np.uint32(1)]
        s[HEIGHT + k] = h00 * n00[0] + h10 * n10[0] + h01 * n01[0] + h11 * n11[0]
        s[SLOPE_X + k] = h00 * n00[1] + h10 * n10[1] + h01 * n01[1] + h11 * n11[1]
        s[SLOPE_Y + k] = h00 * n00[2] + h10 * n10[2] + h01 * n01[2] + h11 * n11[2]


@fast_part
def _walk(n, pose, front, cap, s):
    """Take a Newton step along the viewing ray to where it meets the map.

    A surface seen from behind or at a grazing angle: walk no further than a bounded slope allows.
    """
    tz, ox, oy, inverse = pose[9], pose[10], pose[11], pose[12]
    for k in range(n):
        x, y, z, walked = s[ARM_X + k], s[ARM_Y + k], s[ARM_Z + k], s[WALKED + k]
        shorter = 1.0 / np.sqrt(x * x + y * y + z * z + TINY)
        facing = front * shorter * (z - s[SLOPE_X + k] * x - s[SLOPE_Y + k] * y)
        nu = front * (facing if facing > GRAZING else GRAZING)
        to = walked + (z * (1.0 - walked * shorter) + tz - s[HEIGHT + k]) / nu
        to = to if to < cap else cap
        to = to if to > -cap else -cap
        s[WALKED + k] = to
        scale = (1.0 - to * shorter) * inverse
        s[FRACTION_X + k] = x * scale + ox
        s[FRACTION_Y + k] = y * scale + oy


@fast_part
def _measure_along(n, tz, s):
    """Take the residual at the foot of the ray: the distance walked."""
    for k in range(n):
        x, y, z, walked = s[ARM_X + k], s[ARM_Y + k], s[ARM_Z + k], s[WALKED + k]
        gx, gy = s[SLOPE_X + k], s[SLOPE_Y + k]
        shorter = 1.0 / np.sqrt(x * x + y * y + z * z + TINY)
        nu = shorter * (z - gx * x - gy * y)
        scale = 1.0 - walked * shorter
        s[ARM_X + k], s[ARM_Y + k], s[ARM_Z + k] = x * scale, y * scale, z * scale
        s[RESIDUAL + k] = z * scale + tz - s[HEIGHT + k] + walked * nu
        s[NORM2 + k] = nu * nu + LATERAL * (1.0 + gx * gx + gy * gy)


@fast_part
def _measure_upright(n, tz, slope, s):
    """Take the vertical residual, weighed down on slopes if asked."""
    steep = 1.0 if slope else 0.0
    for k in range(n):
        gx, gy = s[SLOPE_X + k], s[SLOPE_Y + k]
        s[RESIDUAL + k] = s[ARM_Z + k] + tz - s[HEIGHT + k]
        s[NORM2 + k] = 1.0 + steep * (gx * gx + gy * gy)


@part
def _walk_on(n, pose, bounds, nodes, front, cap, s, cells, far, far_cells):
    """Take the second step for the points whose first was long."""
    count = 0
    reach = SHORT / pose[12]
    for k in range(n):
        far_cells[WHICH + count] = k
        count += 1 if (s[ON + k] > 0.0) & (abs(s[WALKED + k]) >= reach) else 0
    if count == 0:
        return
    for i in range(count):
        k = far_cells[WHICH + i]
        for row in range(0, ROWS * CHUNK, CHUNK):
            far[row + i] = s[row + k]
    _walk(count, pose, front, cap, far)
    _settle(count, bounds, far, far_cells)
    _look(count, nodes, far, far_cells)
    for i in range(count):
        k = far_cells[WHICH + i]
        for row in range(0, ROWS * CHUNK, CHUNK):
            s[row + k] = far[row + i]
        cells[CELL_X + k], cells[CELL_Y + k] = far_cells[CELL_X + i], far_cells[CELL_Y + i]


@part
def _land(
    points, pose, bounds, nodes, along_ray, slope, front, cap, s, cells, far, far_cells
):  # fmt: skip
    """Fill the rows ``s`` and the ``cells`` of a chunk of points.

    Along the ray a residual is taken at the foot, where the viewing ray meets the map (Newton
    steps; the second only where the first was long): read at the noisy point itself it correlates
    with the map's gradient there, a bias that grows with its variance. ``residual / sqrt(norm2)``
    is the signed distance in metres.
    """
    n = points.shape[0]
    s[ON : ON + n] = 1.0
    _place(points, pose, s)
    _settle(n, bounds, s, cells)
    _look(n, nodes, s, cells)
    if along_ray:
        s[WALKED : WALKED + n] = 0.0
        _walk(n, pose, front, cap, s)
        _settle(n, bounds, s, cells)
        _look(n, nodes, s, cells)
        _walk_on(n, pose, bounds, nodes, front, cap, s, cells, far, far_cells)
        _measure_along(n, pose[9], s)
    else:
        _measure_upright(n, pose[9], slope, s)


@kernel
def feet(points, R, t, origin, spacing, nodes, along_ray, slope, front, cap, rows, cells):
    """Fill ``rows`` (ROWS, n) and ``cells`` (2, n), x and y, with where a frame meets the map."""
    pose = _pose(R, t, origin, spacing)
    bounds = _inside(nodes, 0, 0, nodes.shape[1], nodes.shape[0])
    s, here = np.zeros(ROWS * CHUNK), np.zeros(2 * CHUNK, np.int32)
    far, far_cells = np.empty(ROWS * CHUNK), np.empty(3 * CHUNK, np.int32)
    for first in range(0, points.shape[0], CHUNK):
        last = min(first + CHUNK, points.shape[0])
        _land(
            points[first:last], pose, bounds, nodes, along_ray, slope, front, cap, s, here, far,
            far_cells,
        )  # fmt: skip
        n = last - first
        for row in range(ROWS):
            rows[row, first:last] = s[row * CHUNK : row * CHUNK + n]
        for row in range(2):
            cells[row, first:last] = here[row * CHUNK : row * CHUNK + n]


@fast_part
def _weigh(inverse_noise, shares, c2, s, weights, residuals):
    """Give every point its robust weight and normalised residual, and its whole weight."""
    for k in range(shares.shape[0]):
        r, own, share = s[RESIDUAL + k], np.float64(inverse_noise[k]), np.float64(shares[k])
        counts = s[ON + k] if share > 0.0 else 0.0
        s[ON + k] = counts
        scale2 = own * own / s[NORM2 + k]
        root = c2 / (c2 + r * r * scale2) if c2 > 0.0 else 1.0
        psi = root * root * counts
        weights[k] = psi
        residuals[k] = r * np.sqrt(scale2) if counts > 0.0 else np.nan
        s[WEIGHT + k] = share * psi * scale2


@fast_part
def _cost(inverse_noise, shares, c2, charge, s):
    """Geman-McClure cost of a chunk at the squared scale ``c2``; 0: squares."""
    cost = 0.0
    for k in range(shares.shape[0]):
        r, own, share = s[RESIDUAL + k], np.float64(inverse_noise[k]), np.float64(shares[k])
        e2 = r * r * own * own / s[NORM2 + k]
        e2 = c2 / (c2 + e2) * e2 if c2 > 0.0 else e2
        cost += share * (s[ON + k] * e2 + (1.0 - s[ON + k]) * charge)
    return cost


@fast_part
def _differentiate(n, arm, s):
    """Fill the Jacobian's columns and those times the weights."""
    ax, ay, az = arm[0], arm[1], arm[2]
    for k in range(n):
        gx, gy, w = s[SLOPE_X + k], s[SLOPE_Y + k], s[WEIGHT + k]
        lx, ly, lz = s[ARM_X + k] + ax, s[ARM_Y + k] + ay, s[ARM_Z + k] + az
        j3, j4, j5 = ly + lz * gy, -lz * gx - lx, -lx * gy + ly * gx
        s[JACOBIAN + k], s[JACOBIAN + CHUNK + k] = -gx, -gy
        s[JACOBIAN + 2 * CHUNK + k] = 1.0
        s[JACOBIAN + 3 * CHUNK + k], s[JACOBIAN + 4 * CHUNK + k] = j3, j4
        s[JACOBIAN + 5 * CHUNK + k] = j5
        s[WEIGHED + k], s[WEIGHED + CHUNK + k] = -w * gx, -w * gy
        s[WEIGHED + 2 * CHUNK + k] = w
        s[WEIGHED + 3 * CHUNK + k], s[WEIGHED + 4 * CHUNK + k] = w * j3, w * j4
        s[WEIGHED + 5 * CHUNK + k] = w * j5


@fast_part
def _sum(n, s, A, g):
    """Add the chunk's products of columns to the lower triangle of ``A`` and to ``g``."""
    for m in range(6):
        left = WEIGHED + m * CHUNK
        total = 0.0
        for k in range(n):
            total += s[left + k] * s[RESIDUAL + k]
        g[m] += total
        for j in range(m + 1):
            right = JACOBIAN + j * CHUNK
            total = 0.0
            for k in range(n):
                total += s[left + k] * s[right + k]
            A[m, j] += total


@inlined
def _couple(node, h, w0, w1, w2, w3, w4, w5):
    """Subtract a point's weighted Jacobian, times its share ``h`` of a node, from the coupling."""
    node[0] -= h * w0
    node[1] -= h * w1
    node[2] -= h * w2
    node[3] -= h * w3
    node[4] -= h * w4
    node[5] -= h * w5


@fast_part
def _scatter(n, s, cells, B, bx, by, stencil):
    """Add the chunk's couplings with the map and the map's own terms, node by node."""
    left, low = np.int32(bx), np.int32(by)
    one = np.uint32(1)
    for k in range(n):
        w = s[WEIGHT + k]
        if w == 0.0:
            continue
        a, b, r = s[FRACTION_X + k], s[FRACTION_Y + k], s[RESIDUAL + k]
        h00, h10, h01, h11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        w0, w1, w2 = s[WEIGHED + k], s[WEIGHED + CHUNK + k], s[WEIGHED + 2 * CHUNK + k]
        w3, w4 = s[WEIGHED + 3 * CHUNK + k], s[WEIGHED + 4 * CHUNK + k]
        w5 = s[WEIGHED + 5 * CHUNK + k]
        u, v = cells[CELL_X + k], cells[CELL_Y + k]
        x, y = np.uint32(u - left), np.uint32(v - low)
        _couple(B[y, x], h00, w0, w1, w2, w3, w4, w5)
        _couple(B[y, x + one], h10, w0, w1, w2, w3, w4, w5)
        _couple(B[y + one, x], h01, w0, w1, w2, w3, w4, w5)
        _couple(B[y + one, x + one], h11, w0, w1, w2, w3, w4, w5)
        w00, w10, w01, w11 = w * h00, w * h10, w * h01, w * h11
        x, y = np.uint32(u), np.uint32(v)
        node = stencil[y, x]
        node[0] += w00 * h00
        node[1] += w00 * h10
        node[2] += w00 * h01
        node[3] += w00 * h11
        node[4] += w10 * h01
        node[5] -= w00 * r
        node = stencil[y, x + one]
        node[0] += w10 * h10
        node[2] += w10 * h11
        node[5] -= w10 * r
        node = stencil[y + one, x]
        node[0] += w01 * h01
        node[1] += w01 * h11
        node[5] -= w01 * r
        node = stencil[y + one, x + one]
        node[0] += w11 * h11
        node[5] -= w11 * r


@kernel
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
    s, cells = np.empty(ALL), np.empty(2 * CHUNK, np.int32)
    far, far_cells = np.empty(ROWS * CHUNK), np.empty(3 * CHUNK, np.int32)
    block = np.zeros((6, 6))
    for first in range(0, points.shape[0], CHUNK):
        last = min(first + CHUNK, points.shape[0])
        own, share, n = inverse_noise[first:last], shares[first:last], last - first
        _land(
            points[first:last], pose, bounds, nodes, along_ray, slope, front, cap, s, cells, far,
            far_cells,
        )  # fmt: skip
        _weigh(own, share, c2, s, weights[first:last], residuals[first:last])
        part = _cost(own, share, c2, charge, s)
        cost += part
        judged += part if j2 == c2 else _cost(own, share, j2, charge, s)
        used += s[ON : ON + n].sum()
        _differentiate(n, arm, s)
        _sum(n, s, block, g)
        _scatter(n, s, cells, B, bx, by, stencil)
    for m in range(6):
        for j in range(6):
            A[m, j] += block[max(m, j), min(m, j)]
    return cost, judged, used
