"""MuJoCo's own OpenGL renderer, a cross-check of the ray caster where EGL or OSMesa is there.

    with GlRenderer(model) as gl:
        depth = gl.depth(camera, T_world_camera, data)

Joints move by `data`, an MjData that holds the forward kinematics; without it the model is drawn
at its initial pose. OpenGL clips what is nearer than `near` and lays textures on with its own
filter; else its images have the pixels of the ray caster's. One context belongs to one thread.
"""

from __future__ import annotations

import copy
import os
import subprocess
import sys
from functools import cache
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba.camera import Camera
from depthba.errors import MissingPackage
from sim.engine import mujoco
from sim.errors import SimulationError

Array = NDArray[np.float64]

PLATFORMS = {"egl": "libegl1 libgl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
"""What can draw without a screen, in the order of trial, and its Debian packages."""

FACETS = 256
"""Slices and stacks of round shapes; MuJoCo's 28 would be off by up to 1.3 mm."""

_TRIAL = "import sys; from sim.rendering.gl import _context; _context(sys.argv[1])"


@cache
def available() -> str | None:
    """The first platform that can draw here, `egl` or `osmesa`; None: there is none.

    Tried in processes of their own, because a broken driver takes the process with it.
    """
    for platform in PLATFORMS if sys.platform == "linux" else ():
        environment = {**os.environ, "PYOPENGL_PLATFORM": platform}
        trial = [sys.executable, "-c", _TRIAL, platform]
        try:
            run = subprocess.run(trial, env=environment, capture_output=True, timeout=60)
        except (OSError, subprocess.TimeoutExpired):
            continue
        if run.returncode == 0:
            return platform
    return None


def _context(platform: str) -> Any:
    """A context of OpenGL, made current, in which MuJoCo can draw."""
    os.environ["PYOPENGL_PLATFORM"] = platform  # mujoco's modules insist on it
    if platform == "egl":
        from mujoco.egl import GLContext
    else:
        from mujoco.osmesa import GLContext
    context = GLContext(64, 64)
    context.make_current()
    mujoco.MjrContext(
        mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100
    ).free()
    return context


class GlRenderer:
    """Draws one model; its scene, its buffers and its context last until `close`."""

    def __init__(
        self,
        model: mujoco.MjModel,
        groups: tuple[int, ...] = (0, 1, 2),
        near: float = 0.02,
        far: float = 100.0,
    ) -> None:
        """Get ready to draw the visible geoms between `near` and `far`, m.

        Raises MissingPackage where neither EGL nor OSMesa works.
        """
        platform = available()
        if platform is None:
            packages = " or ".join(PLATFORMS.values())
            raise MissingPackage(
                f"renderer mujoco: neither EGL nor OSMesa works here; install {packages}, "
                "or choose the renderer embree"
            )
        self._model = copy.copy(model)
        self._model.vis.quality.numslices = self._model.vis.quality.numstacks = FACETS
        self._model.vis.quality.offsamples = 0  # a mean of depths is no depth
        self._near, self._far = near, far
        self._rest = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._rest)
        self._context = _context(platform)
        self._scene = mujoco.MjvScene(self._model, maxgeom=model.ngeom + model.nlight + 16)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 0  # rays know no back
        self._look = mujoco.MjvOption()
        self._look.geomgroup[:] = [group in groups for group in range(mujoco.mjNGROUP)]
        self._look.sitegroup[:] = 0
        self._drawing: mujoco.MjrContext | None = None

    def __enter__(self) -> GlRenderer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give the buffers and the context back."""
        if self._context is not None:
            self._context.make_current()
            if self._drawing is not None:
                self._drawing.free()
            self._context.free()
            self._context = self._drawing = None

    def depth(
        self, camera: Camera, T_world_camera: Array, data: mujoco.MjData | None = None
    ) -> Array:
        """Depth (height, width), m; NaN where there is nothing."""
        window = self._draw(camera, T_world_camera, data, plain=True)
        buffer = np.empty((camera.height, camera.width), np.float32)
        mujoco.mjr_readPixels(None, buffer, window, self._drawing)
        # Reversed depth d = a + b / z, 1 at `near` and 0 at `far`.
        b = self._near * self._far / (self._far - self._near)
        a = -b / self._far
        stored = buffer[::-1].astype(float)
        return np.where(stored > 0.0, b / np.where(stored > 0.0, stored - a, 1.0), np.nan)

    def segmentation(
        self, camera: Camera, T_world_camera: Array, data: mujoco.MjData | None = None
    ) -> NDArray[np.int64]:
        """The geom id (height, width) of each pixel; -1 where there is nothing."""
        window = self._draw(camera, T_world_camera, data, plain=True)
        buffer = np.empty((camera.height, camera.width, 3), np.uint8)
        mujoco.mjr_readPixels(buffer, None, window, self._drawing)
        number = buffer[::-1].astype(np.int64) @ [1, 1 << 8, 1 << 16]
        geom = np.full(self._scene.ngeom + 1, -1, np.int64)
        for drawn in self._scene.geoms[: self._scene.ngeom]:
            if drawn.segid >= 0 and drawn.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                geom[drawn.segid + 1] = drawn.objid
        return geom[number]

    def rgb(
        self, camera: Camera, T_world_camera: Array, data: mujoco.MjData | None = None
    ) -> NDArray[np.uint8]:
        """The colour image (height, width, 3), by the model's lights and its headlight."""
        window = self._draw(camera, T_world_camera, data, plain=False)
        buffer = np.empty((camera.height, camera.width, 3), np.uint8)
        mujoco.mjr_readPixels(buffer, None, window, self._drawing)
        return np.ascontiguousarray(buffer[::-1])

    def _draw(
        self, camera: Camera, T: Array, data: mujoco.MjData | None, plain: bool
    ) -> mujoco.MjrRect:
        """Draw, in the geoms' numbers for colours where `plain`; the part of the buffer drawn."""
        if any(camera.distortion):
            raise SimulationError(
                f"renderer mujoco: distortion {camera.distortion}: expected a camera without"
            )
        if self._context is None:
            raise SimulationError("renderer mujoco: closed")
        self._context.make_current()
        self._make_room(camera)
        mujoco.mjv_updateScene(
            self._model, data or self._rest, self._look, None, mujoco.MjvCamera(),
            mujoco.mjtCatBit.mjCAT_ALL, self._scene,
        )  # fmt: skip
        self._aim(camera, T)
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            self._scene.flags[flag] = plain
        window = mujoco.MjrRect(0, 0, camera.width, camera.height)
        mujoco.mjr_render(window, self._scene, self._drawing)
        return window

    def _make_room(self, camera: Camera) -> None:
        """Have buffers that the image fits into."""
        room = self._model.vis.global_
        if (
            self._drawing is not None
            and room.offwidth >= camera.width
            and room.offheight >= camera.height
        ):
            return
        room.offwidth, room.offheight = camera.width, camera.height
        if self._drawing is not None:
            self._drawing.free()
        self._drawing = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawing)
        self._drawing.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR

    def _aim(self, camera: Camera, T: Array) -> None:
        """Put the eye at T_world_camera, its frustum through the outer rims of the pixels."""
        left, right = ((u - camera.cx) / camera.fx * self._near for u in (-0.5, camera.width - 0.5))
        top, bottom = (
            (camera.cy - v) / camera.fy * self._near for v in (-0.5, camera.height - 0.5)
        )
        for eye in self._scene.camera:  # the mean of the two is drawn
            eye.pos, eye.forward, eye.up = T[:3, 3], T[:3, 2], -T[:3, 1]
            eye.frustum_center, eye.frustum_width = 0.5 * (left + right), 0.5 * (right - left)
            eye.frustum_bottom, eye.frustum_top = bottom, top
            eye.frustum_near, eye.frustum_far = self._near, self._far
            eye.orthographic = 0
        for light in self._scene.lights[: self._scene.nlight]:
            if light.headlight:
                light.pos, light.dir = T[:3, 3], T[:3, 2]
