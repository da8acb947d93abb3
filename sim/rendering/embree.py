"""Embree's packets of 16 rays, from compiled loops.

The package embreex casts one ray at a time, from Python; neighbouring rays cast together are four
times as fast. So the loops here call the library that embreex brings along, by its C interface
(Embree 4, rtcore.h). Where that library cannot be found, embreex itself is asked instead.
"""

from __future__ import annotations

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import ctypes
import importlib.metadata
from functools import cache
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from depthba.errors import MissingPackage

Floats = NDArray[np.float32]

LANES = 16

_COHERENT, _ROBUST = 1 << 16, 1 << 2
_TRIANGLES, _INDEX, _VERTEX, _UINT3, _FLOAT3 = 0, 0, 1, 0x5003, 0x9003


class _Arguments(ctypes.Structure):
    """RTCIntersectArguments, and RTCOccludedArguments too."""

    _fields_ = (
        ("flags", ctypes.c_int),
        ("feature_mask", ctypes.c_uint),
        ("context", ctypes.c_void_p),
        ("filter", ctypes.c_void_p),
        ("callback", ctypes.c_void_p),
    )


@cache
def _library() -> ctypes.CDLL | None:
    """The Embree 4 that embreex was built with."""
    try:
        import embreex.rtcore_scene  # noqa: F401 - loads what the library itself needs

        files = importlib.metadata.files("embreex") or []
    except ImportError as error:
        raise MissingPackage(
            f"embreex is not installed ({error}): pip install 'depthba[sim]'"
        ) from error
    for file in files:
        if "embree4" in file.name and file.suffix != ".pxd":
            try:
                return _declared(ctypes.CDLL(str(file.locate())))
            except (OSError, AttributeError):
                return None
    return None


def _declared(library: ctypes.CDLL) -> ctypes.CDLL:
    pointer, number, size = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
    for name, result, arguments in (
        ("rtcNewDevice", pointer, [ctypes.c_char_p]),
        ("rtcReleaseDevice", None, [pointer]),
        ("rtcNewScene", pointer, [pointer]),
        ("rtcReleaseScene", None, [pointer]),
        ("rtcSetSceneFlags", None, [pointer, number]),
        ("rtcNewGeometry", pointer, [pointer, number]),
        ("rtcSetNewGeometryBuffer", pointer, [pointer, number, number, number, size, size]),
        ("rtcCommitGeometry", None, [pointer]),
        ("rtcAttachGeometry", number, [pointer, pointer]),
        ("rtcReleaseGeometry", None, [pointer]),
        ("rtcCommitScene", None, [pointer]),
        ("rtcIntersect16", None, [pointer] * 4),
        ("rtcOccluded16", None, [pointer] * 4),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


class Packets:
    """Triangles in Embree's hands, for the compiled loops below: `handle` is their argument."""

    def __init__(self, vertices: Floats, faces: NDArray[np.int32]) -> None:
        """Build the acceleration structure over vertices (n, 3) and faces (m, 3)."""
        library = _library()
        assert library is not None
        self._library = library
        self._device = library.rtcNewDevice(b"threads=1,set_affinity=0")
        self._scene = library.rtcNewScene(self._device)
        # Else a ray in a million slips through where two triangles meet.
        library.rtcSetSceneFlags(self._scene, _ROBUST)
        geometry = library.rtcNewGeometry(self._device, _TRIANGLES)
        for role, kind, data in ((_VERTEX, _FLOAT3, vertices), (_INDEX, _UINT3, faces)):
            there = library.rtcSetNewGeometryBuffer(geometry, role, 0, kind, 12, len(data))
            ctypes.memmove(there, data.tobytes(), data.nbytes)
        library.rtcCommitGeometry(geometry)
        library.rtcAttachGeometry(self._scene, geometry)
        library.rtcReleaseGeometry(geometry)
        library.rtcCommitScene(self._scene)
        self._arguments = _Arguments(_COHERENT, 0xFFFFFFFF, None, None, None)
        functions = (library.rtcIntersect16, library.rtcOccluded16)
        self.handle = np.array(
            [
                self._scene,
                ctypes.addressof(self._arguments),
                *(ctypes.cast(f, ctypes.c_void_p).value for f in functions),
            ],
            np.int64,
        )
        """Addresses of the scene, its arguments and the two functions."""

    def __del__(self) -> None:
        if hasattr(self, "_scene"):
            self._library.rtcReleaseScene(self._scene)
            self._library.rtcReleaseDevice(self._device)

    def first(self, origins: Floats, directions: Floats) -> NDArray[np.int32]:
        """The triangle that each ray (n, 3) meets first, -1: none. One origin (1, 3) will do."""
        found = np.empty(len(directions), np.int32)
        _first(self.handle, origins, directions, found)
        return found

    def blocked(self, origins: Floats, directions: Floats, reach: Floats) -> NDArray[np.bool_]:
        """Whether a ray meets anything within `reach` (n,) or (1,) lengths of its direction.

        One origin (1, 3) or one direction (1, 3) will do for all.
        """
        found = np.empty(max(len(origins), len(directions)), np.bool_)
        _blocked(self.handle, origins, directions, reach, found)
        return found


class Singles:
    """The same by embreex's own loop, one ray at a time."""

    handle = None

    def __init__(self, vertices: Floats, faces: NDArray[np.int32]) -> None:
        """Build the acceleration structure over vertices (n, 3) and faces (m, 3)."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene: Any = EmbreeScene(robust=True)
        self._mesh = TriangleMesh(self._scene, vertices, faces)

    def first(self, origins: Floats, directions: Floats) -> NDArray[np.int32]:
        """The triangle that each ray (n, 3) meets first, -1: none. One origin (1, 3) will do."""
        origins = np.ascontiguousarray(np.broadcast_to(origins, directions.shape))
        return np.asarray(self._scene.run(origins, directions), np.int32)

    def blocked(self, origins: Floats, directions: Floats, reach: Floats) -> NDArray[np.bool_]:
        """Whether a ray meets anything within `reach` (n,) or (1,) lengths of its direction."""
        shape = np.broadcast_shapes(origins.shape, directions.shape)
        o, d = (np.ascontiguousarray(np.broadcast_to(a, shape)) for a in (origins, directions))
        far = np.array(np.broadcast_to(reach, shape[:1]))
        found = np.asarray(self._scene.run(o, d, far, query="OCCLUDED")) >= 0
        return np.asarray(found & np.isfinite(o + d).all(axis=1))


def build(vertices: Floats, faces: NDArray[np.int32]) -> Packets | Singles:
    """The triangles, ready for rays, by the quickest way there is."""
    if not len(faces) or _library() is None:
        return Singles(vertices, faces)
    return Packets(vertices, faces)


@intrinsic
def _call(context, function, valid, scene, packet, arguments):
    """Call a C function of four pointers by its address: such a call can be cached on disk."""

    def lower(context, builder, signature, values):
        word = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [word] * 4)
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), values[1:])
        return context.get_dummy_value()

    return types.void(*[types.int64] * 5), lower


# RTCRayHit16 by rows of 16: origin 0-2, tnear 3, direction 4-6, time 7, tfar 8, mask 9, id 10,
# flags 11, normal 12-14, u 15, v 16, triangle 17, geometry 18, instances from 19 on.
_ORIGIN, _NEAR, _DIRECTION, _TIME, _FAR, _MASK, _ID, _FLAGS, _TRIANGLE, _GEOMETRY, _ROWS = (
    0, 3, 4, 7, 8, 9, 10, 11, 17, 18, 22,
)  # fmt: skip


@nb.njit(cache=True, nogil=True)
def _new_packet():
    """Two views of one packet, as floats and as integers (rows, 16), and its mask (1, 16)."""
    room = np.zeros((_ROWS + 2) * LANES, np.float32)
    skip = (-room.ctypes.data % 64) // 4  # Embree wants it aligned
    floats = room[skip : skip + (_ROWS + 1) * LANES].reshape(_ROWS + 1, LANES)
    return floats[:_ROWS], floats.view(np.int32)[:_ROWS], floats.view(np.int32)[_ROWS:]


@nb.njit(cache=True, nogil=True, inline="always")
def _intersect(handle, floats, ints, valid):
    """Find the first hits of the packet's valid rays: `ints[17]`, with -1 in `ints[18]` for none.

    Origin and direction must be set (rows 0-2 and 4-6).
    """
    floats[_NEAR] = 0.0
    floats[_TIME] = 0.0
    floats[_FAR] = np.inf
    ints[_MASK] = -1
    ints[_FLAGS] = 0
    ints[_TRIANGLE] = -1
    ints[_GEOMETRY] = -1
    _call(handle[2], valid.ctypes.data, handle[0], floats.ctypes.data, handle[1])


@nb.njit(cache=True, nogil=True)
def _first(handle, origins, directions, found):
    floats, ints, valid = _new_packet()
    one = 0 if len(origins) == 1 else 1
    for begin in range(0, len(directions), LANES):
        for lane in range(LANES):
            i = begin + lane
            valid[0, lane] = -1 if i < len(directions) else 0
            if i < len(directions):
                for c in range(3):
                    floats[_ORIGIN + c, lane] = origins[i * one, c]
                    floats[_DIRECTION + c, lane] = directions[i, c]
        _intersect(handle, floats, ints, valid)
        for lane in range(min(LANES, len(directions) - begin)):
            found[begin + lane] = ints[_TRIANGLE, lane] if ints[_GEOMETRY, lane] >= 0 else -1


@nb.njit(cache=True, nogil=True)
def _blocked(handle, origins, directions, reach, found):
    floats, ints, valid = _new_packet()
    one = 0 if len(origins) == 1 else 1
    each = 0 if len(directions) == 1 else 1
    limit = 0 if len(reach) == 1 else 1
    for begin in range(0, len(found), LANES):
        floats[_NEAR] = 0.0
        floats[_TIME] = 0.0
        ints[_MASK] = -1
        ints[_FLAGS] = 0
        for lane in range(LANES):
            i, good = begin + lane, True
            if i < len(found):
                for c in range(3):
                    o, d = origins[i * one, c], directions[i * each, c]
                    floats[_ORIGIN + c, lane], floats[_DIRECTION + c, lane] = o, d
                    good = good and np.isfinite(o + d)
                floats[_FAR, lane] = reach[i * limit]
            valid[0, lane] = -1 if good and i < len(found) else 0
        _call(handle[3], valid.ctypes.data, handle[0], floats.ctypes.data, handle[1])
        for lane in range(min(LANES, len(found) - begin)):
            found[begin + lane] = valid[0, lane] != 0 and floats[_FAR, lane] < 0.0


@nb.njit(cache=True, nogil=True, inline="always")
def _along(plane, k, ox, oy, oz, dx, dy, dz):
    """Distance to a triangle's plane along a ray; NaN where they are parallel."""
    n = plane[k]
    towards = n[0] * dx + n[1] * dy + n[2] * dz
    if towards == 0.0:
        return np.nan
    return (n[3] - n[0] * ox - n[1] * oy - n[2] * oz) / towards


@nb.njit(cache=True, nogil=True)
def measure(found, origins, directions, plane, owner, distance, triangle, geom):
    """Fill distance, triangle and geom of rays (n,) that found these triangles."""
    one = 0 if len(origins) == 1 else 1
    for i in range(len(found)):
        k = found[i]
        o, d = origins[i * one], directions[i]
        distance[i] = _along(plane, k, o[0], o[1], o[2], d[0], d[1], d[2]) if k >= 0 else np.nan
        seen = k >= 0 and not np.isnan(distance[i])
        triangle[i] = k if seen else -1
        geom[i] = owner[k] if seen else -1


@nb.njit(cache=True, nogil=True)
def view(handle, rays, T, plane, owner, distance, triangle, geom):
    """Fill distance, triangle and geom (height, width) of a camera's rays, by squares of 4 x 4."""
    floats, ints, valid = _new_packet()
    directions = np.empty((LANES, 3))
    height, width = distance.shape
    ox, oy, oz = T[0, 3], T[1, 3], T[2, 3]
    floats[_ORIGIN], floats[_ORIGIN + 1], floats[_ORIGIN + 2] = ox, oy, oz
    for top in range(0, height, 4):
        for left in range(0, width, 4):
            for lane in range(LANES):
                y, x = top + lane // 4, left + lane % 4
                valid[0, lane] = 0
                if y < height and x < width:
                    a, b, c = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
                    valid[0, lane] = -1 if np.isfinite(a + b + c) else 0
                    for r in range(3):
                        d = T[r, 0] * a + T[r, 1] * b + T[r, 2] * c
                        directions[lane, r] = d
                        floats[_DIRECTION + r, lane] = d
            _intersect(handle, floats, ints, valid)
            for lane in range(LANES):
                y, x = top + lane // 4, left + lane % 4
                if y >= height or x >= width:
                    continue
                k = ints[_TRIANGLE, lane] if ints[_GEOMETRY, lane] >= 0 else -1
                t = np.nan
                if k >= 0:
                    d = directions[lane]
                    t = _along(plane, k, ox, oy, oz, d[0], d[1], d[2])
                seen = not np.isnan(t)
                distance[y, x] = t
                triangle[y, x] = k if seen else -1
                geom[y, x] = owner[k] if seen else -1
