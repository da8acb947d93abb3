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


@nb.njit(cache=True, nogil=True)
def nodal_gradients(heights, spacing, nodes):
    """Fill ``nodes`` (ny, nx, 3) with heights and central differences, one-sided at the border."""
    ny, nx = heights.shape
    for y in range(ny):
        y0, y1 = max(y - 1, 0), min(y + 1, ny - 1)
        for x in range(nx):
            x0, x1 = max(x - 1, 0), min(x + 1, nx - 1)
            nodes[y, x, 0] = heights[y, x]
            nodes[y, x, 1] = (heights[y, x1] - heights[y, x0]) / ((x1 - x0) * spacing)
            nodes[y, x, 2] = (heights[y1, x] - heights[y0, x]) / ((y1 - y0) * spacing)


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
def _residual(px, py, pz, R, t, origin, spacing, nodes, along_ray, slope, front, cap):
    """Residual of one point.

    Returns: on the map?, cell x, y, fractions a, b, the point (3 values) relative to t, residual,
    norm, gx, gy. ``residual / norm`` is the signed distance in metres. Along the ray it is taken at
    the foot, where the viewing ray meets the map (two Newton steps): a residual read at the noisy
    point itself correlates with the map's gradient there, a bias that grows with its variance.
    """
    ny, nx = nodes.shape[0], nodes.shape[1]
    qx = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
    qy = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
    qz = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
    cx, cy = (qx + t[0] - origin[0]) / spacing, (qy + t[1] - origin[1]) / spacing
    x, y = int(np.floor(cx)), int(np.floor(cy))
    on = x >= 1 and y >= 1 and x < nx - 2 and y < ny - 2
    ux, uy, uz, walked = 0.0, 0.0, 1.0, 0.0
    d, gx, gy = 0.0, 0.0, 0.0
    fx, fy, fz = qx, qy, qz
    if on and along_ray:
        length = np.sqrt(qx * qx + qy * qy + qz * qz)
        ux, uy, uz = qx / length, qy / length, qz / length
        for _ in range(2):
            d, gx, gy = _read(nodes, x, y, cx - x, cy - y)
            nu = front * (uz - gx * ux - gy * uy)
            # a surface seen from behind or at a grazing angle: walk no further than a bounded slope
            # allows
            nu = front * max(nu, GRAZING)
            step = (fz + t[2] - d) / nu
            walked = min(max(walked + step, -cap), cap)
            fx, fy, fz = qx - walked * ux, qy - walked * uy, qz - walked * uz
            cx, cy = (fx + t[0] - origin[0]) / spacing, (fy + t[1] - origin[1]) / spacing
            x, y = int(np.floor(cx)), int(np.floor(cy))
            on = x >= 1 and y >= 1 and x < nx - 2 and y < ny - 2
            if not on:
                break
    r, norm = 0.0, 1.0
    if on:
        d, gx, gy = _read(nodes, x, y, cx - x, cy - y)
        r = fz + t[2] - d
        n2 = 1.0 + gx * gx + gy * gy
        if along_ray:
            nu = uz - gx * ux - gy * uy
            r += walked * nu
            norm = np.sqrt(nu * nu + LATERAL * n2)
        elif slope:
            norm = np.sqrt(n2)
    return on, x, y, cx - x, cy - y, fx, fy, fz, r, norm, gx, gy


@nb.njit(cache=True, nogil=True, fastmath={"contract", "arcp"})
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
    j = np.zeros(6)
    height, width = B.shape[0], B.shape[1]
    for k in range(points.shape[0]):
        own = points[k, 3]
        share = points[k, 4]
        on, x, y, a, b, qx, qy, qz, r, norm, gx, gy = _residual(
            points[k, 0], points[k, 1], points[k, 2], R, t, origin, spacing, nodes,
            along_ray, slope, front, cap,
        )  # fmt: skip
        on = on and x >= bx and y >= by and x + 1 < bx + width and y + 1 < by + height
        if not on or share <= 0.0:
            cost += share * charge
            judged += share * charge
            weights[k] = 0.0
            residuals[k] = np.nan
            continue
        scale = own / norm
        e = r * scale
        e2 = e * e
        psi = 1.0
        if c2 > 0.0:
            root = c2 / (c2 + e2)
            psi = root * root
            cost += share * root * e2
        else:
            cost += share * e2
        judged += share * (e2 * j2 / (j2 + e2) if j2 > 0.0 else e2)
        used += 1
        weights[k] = psi
        residuals[k] = e
        w = share * psi * scale * scale
        lx, ly, lz = qx + arm[0], qy + arm[1], qz + arm[2]
        j[0], j[1], j[2] = -gx, -gy, 1.0
        j[3], j[4], j[5] = ly + lz * gy, -lz * gx - lx, -lx * gy + ly * gx
        h00, h10, h01, h11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        lower, upper = B[y - by], B[y + 1 - by]
        for m in range(6):
            wj = w * j[m]
            g[m] += wj * r
            for n in range(m + 1):
                A[m, n] += wj * j[n]
            lower[x - bx, m] -= wj * h00
            lower[x + 1 - bx, m] -= wj * h10
            upper[x - bx, m] -= wj * h01
            upper[x + 1 - bx, m] -= wj * h11
        s00, s10, s01, s11 = (
            stencil[y, x],
            stencil[y, x + 1],
            stencil[y + 1, x],
            stencil[y + 1, x + 1],
        )
        s00[0] += w * h00 * h00
        s10[0] += w * h10 * h10
        s01[0] += w * h01 * h01
        s11[0] += w * h11 * h11
        s00[1] += w * h00 * h10
        s01[1] += w * h01 * h11
        s00[2] += w * h00 * h01
        s10[2] += w * h10 * h11
        s00[3] += w * h00 * h11
        s00[4] += w * h10 * h01
        wr = w * r
        s00[5] -= h00 * wr
        s10[5] -= h10 * wr
        s01[5] -= h01 * wr
        s11[5] -= h11 * wr
    return cost, judged, used


@nb.njit(cache=True, nogil=True)
def block_gradient(
    points, R, t, arm, origin, spacing, nodes, along_ray, slope, front, cap,
    weights, members, g, gradient,
):  # fmt: skip
    """Add what the points ``members`` contribute to ``g`` (6,) and to ``gradient`` (ny, nx)."""
    for k in members:
        if weights[k] <= 0.0:
            continue
        on, x, y, a, b, qx, qy, qz, r, norm, gx, gy = _residual(
            points[k, 0], points[k, 1], points[k, 2], R, t, origin, spacing, nodes,
            along_ray, slope, front, cap,
        )  # fmt: skip
        if not on:
            continue
        scale = points[k, 3] / norm
        wr = points[k, 4] * weights[k] * scale * scale * r
        lx, ly, lz = qx + arm[0], qy + arm[1], qz + arm[2]
        g[0] -= wr * gx
        g[1] -= wr * gy
        g[2] += wr
        g[3] += wr * (ly + lz * gy)
        g[4] += wr * (-lz * gx - lx)
        g[5] += wr * (-lx * gy + ly * gx)
        gradient[y, x] -= (1 - a) * (1 - b) * wr
        gradient[y, x + 1] -= a * (1 - b) * wr
        gradient[y + 1, x] -= (1 - a) * b * wr
        gradient[y + 1, x + 1] -= a * b * wr


@nb.njit(cache=True, nogil=True)
def noise_gradient(
    points, R, t, origin, spacing, nodes, along_ray, slope, front, cap, weights, draws, gradient,
):  # fmt: skip
    """Add to ``gradient`` (ny, nx) what residuals ``draws`` (n,) times the points' sigma would."""
    for k in range(points.shape[0]):
        if weights[k] <= 0.0:
            continue
        on, x, y, a, b, _, _, _, _, norm, _, _ = _residual(
            points[k, 0], points[k, 1], points[k, 2], R, t, origin, spacing, nodes,
            along_ray, slope, front, cap,
        )  # fmt: skip
        if not on:
            continue
        e = points[k, 4] * weights[k] * points[k, 3] / norm * draws[k]
        gradient[y, x] -= (1 - a) * (1 - b) * e
        gradient[y, x + 1] -= a * (1 - b) * e
        gradient[y + 1, x] -= (1 - a) * b * e
        gradient[y + 1, x + 1] -= a * b * e


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
    height, width = B.shape[0], B.shape[1]
    for k in range(points.shape[0]):
        if weights[k] <= 0.0:
            continue
        on, x, y, a, b, qx, qy, qz, _, norm, _, _ = _residual(
            points[k, 0], points[k, 1], points[k, 2], R, t, origin, spacing, nodes,
            along_ray, slope, front, cap,
        )  # fmt: skip
        if not (on and x >= bx and y >= by and x + 1 < bx + width and y + 1 < by + height):
            continue
        scale = points[k, 3] / norm
        w = points[k, 4] * weights[k] * scale * scale
        _, gx, gy = _read(noise, x, y, a, b)
        lx, ly, lz = qx + arm[0], qy + arm[1], qz + arm[2]
        j[0], j[1], j[2] = -gx, -gy, 0.0
        j[3], j[4], j[5] = lz * gy, -lz * gx, -lx * gy + ly * gx
        h00, h10, h01, h11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        lower, upper = B[y - by], B[y + 1 - by]
        for m in range(6):
            wj = w * j[m]
            for n in range(m + 1):
                A[m, n] += wj * j[n]
            lower[x - bx, m] -= wj * h00
            lower[x + 1 - bx, m] -= wj * h10
            upper[x - bx, m] -= wj * h01
            upper[x + 1 - bx, m] -= wj * h11


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
