"""Kernels over the nodes of a map: their gradients, their sums, what falls on them."""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numpy as np

from depthba.compiling import kernel


@kernel
def nodal_rows(heights, spacing, nodes, first, last):
    """Fill ``nodes`` (ny, nx, 3) with heights and central differences, one-sided at the border.

    Of the rows ``first`` to ``last`` alone.
    """
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


@kernel
def collect(
    totals, heights, smooth, weight, first, last, own, right, up, up_right, up_left, gradient
):  # fmt: skip
    """Sum the stencils ``totals`` (parts, ny, nx, 6) over some rows.

    Rows ``first`` to ``last``. Adds the smoothing term, ``weight`` times the squared difference of
    neighbouring heights where both are ``smooth``, and returns its cost. Nodes that nothing touches
    stay what they are: they get a diagonal of 1. Those that are touched and not smooth are damped:
    a few strays alone would send them far off.
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
            elif o > 0.0:
                o += 2 * weight
            own[y, x] = o if o > 0.0 else 1.0
            right[y, x] = r
            up[y, x] = u
            up_right[y, x] = d
            up_left[y, x] = a
            gradient[y, x] = g
    return cost


@kernel
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


@kernel
def look_up(points, R, t, origin, spacing, field, out):
    """Write to ``out`` (n,) the field's value at the node nearest to each point; 1 off the grid."""
    ny, nx = field.shape
    for k in range(points.shape[0]):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        qx = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
        qy = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
        x = int(np.floor((qx - origin[0]) / spacing + 0.5))
        y = int(np.floor((qy - origin[1]) / spacing + 0.5))
        out[k] = field[y, x] if 0 <= x < nx and 0 <= y < ny else 1.0


@kernel
def splat_residuals(points, R, t, origin, spacing, nodes, out):
    """Add the points' vertical distances from the map to the nodes nearest to them.

    Sum, squares and number, (ny, nx, 3).
    """
    ny, nx = out.shape[:2]
    for k in range(points.shape[0]):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        cx = (R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0] - origin[0]) / spacing
        cy = (R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1] - origin[1]) / spacing
        x, y = int(np.floor(cx)), int(np.floor(cy))
        if x < 1 or y < 1 or x >= nx - 2 or y >= ny - 2:
            continue
        a, b = cx - x, cy - y
        height = (1 - b) * ((1 - a) * nodes[y, x, 0] + a * nodes[y, x + 1, 0])
        height += b * ((1 - a) * nodes[y + 1, x, 0] + a * nodes[y + 1, x + 1, 0])
        r = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2] - height
        x, y = int(np.floor(cx + 0.5)), int(np.floor(cy + 0.5))
        out[y, x, 0] += r
        out[y, x, 1] += r * r
        out[y, x, 2] += 1.0


@kernel
def pool_scatter(found, squares, freedom):
    """Add the scatter about their mean of what fell on nodes, and its degrees of freedom.

    ``found`` is what :func:`splat_residuals` leaves.
    """
    ny, nx = squares.shape
    for y in range(ny):
        for x in range(nx):
            total, square, count = found[y, x]
            if count > 1.0:
                squares[y, x] += square - total * total / count
                freedom[y, x] += count - 1.0
