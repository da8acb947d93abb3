"""The loops that paint: what faces the lamp, and the colour of every pixel.

A texture is averaged over the pixel's footprint: bilinear look-ups, two for every texel along each
side, at a level of its pyramid where these are few.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

TAPS = 8
"""Most look-ups along each side of a pixel's footprint."""

GRAIN_CELL = 0.007
"""Width of a speckle of loose ground, m."""


@nb.njit(cache=True, nogil=True)
def _bilinear(texels, start, height, width, u, v, wrap, colour):
    """Add the colour at (u, v), in texels, to `colour`."""
    x, y = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
    a, b = u - 0.5 - x, v - 0.5 - y
    x1, y1 = x + 1, y + 1
    if x < 0 or y < 0 or x1 >= width or y1 >= height:
        if wrap:
            x, x1, y, y1 = x % width, x1 % width, y % height, y1 % height
        else:
            x, x1 = min(max(x, 0), width - 1), min(max(x1, 0), width - 1)
            y, y1 = min(max(y, 0), height - 1), min(max(y1, 0), height - 1)
    here, below = start + y * width, start + y1 * width
    w00, w10, w01, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    for c in range(3):
        colour[c] += (
            w00 * texels[here + x, c]
            + w10 * texels[here + x1, c]
            + w01 * texels[below + x, c]
            + w11 * texels[below + x1, c]
        )


@nb.njit(cache=True, nogil=True)
def sample(texels, start, size, levels, face, uv, ux, vx, uy, vy, wrap, colour):
    """Fill `colour` (3,) with a texture's mean over a pixel.

    start, size and levels are those of one texture; (ux, vx) and (uy, vy) are the footprint's
    sides, in coordinates that run from 0 to 1 over the image.
    """
    height, width = size[0, 0], size[0, 1]
    side_x = np.hypot(ux * width, vx * height)
    side_y = np.hypot(uy * width, vy * height)
    if not abs(uv[0]) + abs(uv[1]) + side_x + side_y < 1e9:  # a ray along the surface
        colour[:] = texels[start[levels - 1] + face]
        return
    # The level at which the shorter side is 1 to 2 texels, unless that takes too many look-ups
    # along the longer one: two for every texel.
    level, short, long = 0, min(side_x, side_y), max(side_x, side_y)
    while level < levels - 1 and (short >= 2.0 or long > 0.5 * TAPS):
        level, short, long = level + 1, 0.5 * short, 0.5 * long
    each = 2.0 / 2**level
    nx = min(max(int(np.ceil(each * side_x)), 2), TAPS)
    ny = min(max(int(np.ceil(each * side_y)), 2), TAPS)
    height, width = size[level, 0], size[level, 1]
    first = start[level] + face * height * width
    colour[:] = 0.0
    for i in range(nx):
        p = (i + 0.5) / nx - 0.5
        for j in range(ny):
            q = (j + 0.5) / ny - 0.5
            u, v = uv[0] + p * ux + q * uy, uv[1] + p * vx + q * vy
            _bilinear(texels, first, height, width, u * width, v * height, wrap, colour)
    colour /= nx * ny


@nb.njit(cache=True, nogil=True)
def onto_cube(here, right, below):
    """The face of a cube that a direction (3,) meets; it and its sides become u and v there.

    The table of OpenGL 4.6, section 8.13.
    """
    x, y, z = here[0], here[1], here[2]
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, u, v, m = (0, 2, 1, 0) if x > 0.0 else (1, 2, 1, 0)
        su, sv = (-1.0 if x > 0.0 else 1.0), -1.0
    elif ay >= az:
        face, u, v, m = (2, 0, 2, 1) if y > 0.0 else (3, 0, 2, 1)
        su, sv = 1.0, (1.0 if y > 0.0 else -1.0)
    else:
        face, u, v, m = (4, 0, 1, 2) if z > 0.0 else (5, 0, 1, 2)
        su, sv = (1.0 if z > 0.0 else -1.0), -1.0
    far = max(abs(here[m]), 1e-12)
    sign = 1.0 if here[m] > 0.0 else -1.0
    p, q = su * here[u] / far, sv * here[v] / far
    for side in (right, below):
        grow = sign * side[m]
        a, b = (su * side[u] - p * grow) / far, (sv * side[v] - q * grow) / far
        side[0], side[1] = 0.5 * a, 0.5 * b
    here[0], here[1] = 0.5 + 0.5 * p, 0.5 + 0.5 * q
    return face


@nb.njit(cache=True, nogil=True)
def _place(rays, y, x, t, T):
    """Direction of a pixel's ray and its point at t, world frame (6 values)."""
    a, b, c = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
    dx = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c
    dy = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c
    dz = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c
    return dx, dy, dz, T[0, 3] + t * dx, T[1, 3] + t * dy, T[2, 3] + t * dz


@nb.njit(cache=True, nogil=True)
def _seen_side(normals, k, dx, dy, dz):
    """A triangle's normal on the side it is seen from."""
    nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
    if nx * dx + ny * dy + nz * dz > 0.0:
        return -nx, -ny, -nz
    return nx, ny, nz


@nb.njit(cache=True, nogil=True)
def towards_lamp(triangle, distance, rays, T, normals, lamp, start, pixel):
    """Fill the points (n, 3) that face the lamp and their pixels; return how many there are.

    They are a millimetre off the surface, so that it does not shade itself.
    """
    count, (height, width) = 0, triangle.shape
    for y in range(height):
        for x in range(width):
            k = triangle[y, x]
            if k < 0:
                continue
            dx, dy, dz, px, py, pz = _place(rays, y, x, distance[y, x], T)
            nx, ny, nz = _seen_side(normals, k, dx, dy, dz)
            if nx * lamp[0] + ny * lamp[1] + nz * lamp[2] > 0.0:
                start[count, 0] = px + 1e-3 * nx
                start[count, 1] = py + 1e-3 * ny
                start[count, 2] = pz + 1e-3 * nz
                pixel[count] = y * width + x
                count += 1
    return count


@nb.njit(cache=True, nogil=True)
def _shares(vertices, face, frame):
    """Fill `frame` (3, 3): a corner, and the gradients of the other two corners' shares."""
    a, b, c = vertices[face[0]], vertices[face[1]], vertices[face[2]]
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    scale = 1.0 / max(nx * nx + ny * ny + nz * nz, 1e-300)
    frame[0, 0], frame[0, 1], frame[0, 2] = a[0], a[1], a[2]
    frame[1, 0] = (vy * nz - vz * ny) * scale
    frame[1, 1] = (vz * nx - vx * nz) * scale
    frame[1, 2] = (vx * ny - vy * nx) * scale
    frame[2, 0] = (ny * uz - nz * uy) * scale
    frame[2, 1] = (nz * ux - nx * uz) * scale
    frame[2, 2] = (nx * uy - ny * ux) * scale


@nb.njit(cache=True, nogil=True)
def _dot(row, x, y, z):
    return row[0] * x + row[1] * y + row[2] * z


@nb.njit(cache=True, nogil=True, error_model="numpy")
def shade(
    triangle, geom, distance, lit, rays, T, step_x, step_y,
    vertices, faces, normals, curved, bend, row, laid,
    light, colour, shine, loose, grain,
    texture, wrap, sky, texels, start, size, levels, cube, screen, image,
):  # fmt: skip
    """Fill the image (height, width, 3) with screen values.

    curved and row (m,) say where in bend and laid (k, 3, 3) a triangle's corner normals and
    texture coordinates are, -1: nowhere; either may be of length 0.
    """
    albedo, texel, frame = np.empty(3), np.empty(3), np.empty((3, 3))
    here, right, below = np.empty(3), np.empty(3), np.empty(3)
    top = len(screen) - 1
    height, width = triangle.shape
    for y in range(height):
        for x in range(width):
            k = triangle[y, x]
            dx, dy, dz, px, py, pz = _place(rays, y, x, distance[y, x], T)
            if k < 0:
                albedo[0] = albedo[1] = albedo[2] = 0.02
                if sky >= 0:  # MuJoCo's boxes of sky stand on their side
                    here[0], here[1], here[2] = dx, dz, -dy
                    right[0], right[1], right[2] = T[0, 0], T[2, 0], -T[1, 0]
                    below[0], below[1], below[2] = T[0, 1], T[2, 1], -T[1, 1]
                    for c in range(3):
                        right[c] *= step_x
                        below[c] *= step_y
                    face = onto_cube(here, right, below)
                    sample(
                        texels, start[sky], size[sky], levels[sky], face, here,
                        right[0], right[1], below[0], below[1], False, albedo,
                    )  # fmt: skip
                for c in range(3):
                    image[y, x, c] = screen[int(albedo[c] * top)]
                continue
            g = geom[y, x]
            nx, ny, nz = _seen_side(normals, k, dx, dy, dz)
            for c in range(3):
                albedo[c] = colour[g, c]
            bent = curved[k] if len(curved) else -1
            r = row[k] if len(row) else -1
            if bent >= 0 or r >= 0:
                _shares(vertices, faces[k], frame)
                ax, ay, az = px - frame[0, 0], py - frame[0, 1], pz - frame[0, 2]
                share1, share2 = _dot(frame[1], ax, ay, az), _dot(frame[2], ax, ay, az)
            if r >= 0:
                # The neighbouring pixels' rays meet the surface's plane there: the footprint.
                depth, nd = distance[y, x], nx * dx + ny * dy + nz * dz
                slide = (nx * T[0, 0] + ny * T[1, 0] + nz * T[2, 0]) / nd
                s = step_x * depth
                rx, ry, rz = T[0, 0] - slide * dx, T[1, 0] - slide * dy, T[2, 0] - slide * dz
                right1, right2 = s * _dot(frame[1], rx, ry, rz), s * _dot(frame[2], rx, ry, rz)
                slide = (nx * T[0, 1] + ny * T[1, 1] + nz * T[2, 1]) / nd
                s = step_y * depth
                rx, ry, rz = T[0, 1] - slide * dx, T[1, 1] - slide * dy, T[2, 1] - slide * dz
                below1, below2 = s * _dot(frame[1], rx, ry, rz), s * _dot(frame[2], rx, ry, rz)
                for c in range(3):
                    at = laid[r, 0, c]
                    to1, to2 = laid[r, 1, c] - at, laid[r, 2, c] - at
                    here[c] = at + share1 * to1 + share2 * to2
                    right[c] = right1 * to1 + right2 * to2
                    below[c] = below1 * to1 + below2 * to2
                q = texture[g]
                face, repeat = 0, wrap[g]
                if cube[q]:
                    face, repeat = onto_cube(here, right, below), False
                sample(
                    texels, start[q], size[q], levels[q], face, here,
                    right[0], right[1], below[0], below[1], repeat, texel,
                )  # fmt: skip
                for c in range(3):
                    albedo[c] *= texel[c]
            if loose[g]:
                u, v = int(px / GRAIN_CELL), int(py / GRAIN_CELL)
                speckle = grain[u & (len(grain) - 1), v & (len(grain) - 1)]
                for c in range(3):
                    albedo[c] *= speckle
            if bent >= 0:  # Phong 1975
                side = 1.0 if _dot(normals[k], nx, ny, nz) > 0.0 else -1.0
                b, rest = bend[bent], 1.0 - share1 - share2
                mx = rest * b[0, 0] + share1 * b[1, 0] + share2 * b[2, 0]
                my = rest * b[0, 1] + share1 * b[1, 1] + share2 * b[2, 1]
                mz = rest * b[0, 2] + share1 * b[1, 2] + share2 * b[2, 2]
                side /= max(np.sqrt(mx * mx + my * my + mz * mz), 1e-12)
                nx, ny, nz = side * mx, side * my, side * mz
            up = 0.5 * (1.0 + nz)
            gloss = shine[g, 3]
            diffuse = shine[g, 2] + (1.0 - 0.6 * gloss) * (light[4] * up + light[5] * (1.0 - up))
            glint = 0.0
            facing = nx * light[0] + ny * light[1] + nz * light[2]
            if lit[y, x] and facing > 0.0:
                diffuse += (1.0 - 0.6 * gloss) * light[3] * facing
            if gloss > 0.0:
                length = np.sqrt(dx * dx + dy * dy + dz * dz)
                ex, ey, ez = dx / length, dy / length, dz / length
                # What a mirror would show: the sky's gradient.
                bounced = 0.5 + 0.5 * (ez - 2.0 * nz * (nx * ex + ny * ey + nz * ez))
                diffuse += gloss * (light[4] * bounced + light[5] * (1.0 - bounced))
                if lit[y, x] and facing > 0.0:  # Blinn 1977
                    bx, by, bz = light[0] - ex, light[1] - ey, light[2] - ez
                    half = (nx * bx + ny * by + nz * bz) / np.sqrt(bx * bx + by * by + bz * bz)
                    glint = light[3] * shine[g, 0] * max(half, 0.0) ** shine[g, 1]
            for c in range(3):
                value = albedo[c] * diffuse + glint
                image[y, x, c] = screen[int(min(max(value, 0.0), 1.0) * top)]
