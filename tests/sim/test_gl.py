from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from depthba.camera import Camera
from depthba.errors import MissingPackage
from sim.engine import mujoco
from sim.errors import SimulationError
from sim.rendering import gl
from sim.rendering.raycast import RayScene
from sim.rendering.shading import Lighting, Painter
from tests.sim.test_raycast import KINDS, inside, slanted, zoo
from tests.sim.test_shading import textured

needs_gl = pytest.mark.skipif(
    gl.available() is None, reason="neither EGL nor OSMesa works on this machine"
)
SLANTED = slanted()


@needs_gl
def test_opengl_sees_what_the_rays_see() -> None:
    model = zoo().compile()
    camera = Camera(320, 240, 240.0, 252.0, 150.2, 130.7)  # nothing about it is symmetric
    hits = RayScene.of_model(model).view(camera, SLANTED)
    with gl.GlRenderer(model) as renderer:
        depth = renderer.depth(camera, SLANTED)
        geom = renderer.segmentation(camera, SLANTED)
    assert (geom == hits.geom).mean() > 0.999
    both = inside(geom) & inside(hits.geom) & (geom == hits.geom)
    for k in range(model.ngeom):
        error = np.abs(depth - hits.distance)[both & (geom == k)]
        assert len(error) > 200, f"geom {k} is hardly in sight"
        # Both draw round shapes with facets, which at the rim are seen from the side.
        assert np.quantile(error, 0.95) < 5e-5
        assert error.max() < 3e-4


@needs_gl
def test_the_bay_in_opengl(bay_model: mujoco.MjModel) -> None:
    camera = Camera(320, 240, 277.0, 277.0, 159.5, 119.5)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = 3.5, 3.0, 3.0
    hits = RayScene.of_model(bay_model).view(camera, T)
    with gl.GlRenderer(bay_model) as renderer:
        depth = renderer.depth(camera, T)
        both = inside(hits.geom) & (renderer.segmentation(camera, T) == hits.geom)
    assert both.mean() > 0.5
    assert np.quantile(np.abs(depth - hits.distance)[both], 0.999) < 5e-5


@needs_gl
def test_joints_move_what_opengl_draws_and_nothing_is_nan() -> None:
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
    body.add_geom(type=KINDS.mjGEOM_BOX, size=[0.1, 0.1, 0.1])
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[0] = 0.25
    mujoco.mj_forward(model, data)
    camera, T = Camera(40, 30, 40.0, 40.0, 19.5, 14.5), np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 1.5
    with gl.GlRenderer(model) as renderer:
        for pose, top in ((None, 0.1), (data, 0.35)):
            depth = renderer.depth(camera, T, pose)
            assert depth[15, 20] == pytest.approx(1.5 - top, abs=1e-5)
            assert np.isnan(depth[0, 0])
        with pytest.raises(SimulationError, match="distortion"):
            renderer.depth(Camera(40, 30, 40.0, 40.0, 19.5, 14.5, (0.1, 0, 0, 0, 0)), T)


@needs_gl
@pytest.mark.parametrize("uniform", [False, True])
@pytest.mark.parametrize("sort", ["2d", "cube"])
def test_textures_lie_as_in_opengl(sort: str, uniform: bool) -> None:
    """Glowing textures without any light: both show the texture itself."""
    rng = np.random.default_rng(5)
    spec = zoo()
    spec.visual.headlight.active = 0
    pixels = np.kron(rng.integers(0, 256, (6 if sort == "2d" else 24, 4, 3)), np.ones((16, 16, 1)))
    skin = textured(spec, pixels, cube=sort == "cube", emission=1.0, texuniform=uniform,
                    texrepeat=[1.5, 0.75])  # fmt: skip
    for geom in spec.geoms:
        geom.material = skin
    model = spec.compile()
    camera = Camera(480, 360, 400.0, 400.0, 239.5, 179.5)
    scene = RayScene.of_model(model)
    hits = scene.view(camera, SLANTED)
    dark = Lighting(lamp=0.0, sky=0.0, ground=0.0)
    ours = Painter(scene, model, dark).paint(camera, SLANTED, hits)
    with gl.GlRenderer(model) as renderer:
        theirs = renderer.rgb(camera, SLANTED)
    for k in range(model.ngeom):
        here = inside(hits.geom) & (hits.geom == k)
        close = np.abs(ours[here].astype(int) - theirs[here]).max(axis=1) < 40
        kind = KINDS(int(model.geom_type[k]))
        # In OpenGL a capsule has seams, and a cube's middle plane is undefined.
        if kind != KINDS.mjGEOM_CAPSULE and (kind, sort) != (KINDS.mjGEOM_PLANE, "cube"):
            assert close.mean() > 0.92


@needs_gl
def test_the_sky_hangs_as_in_opengl() -> None:
    spec, rng = mujoco.MjSpec(), np.random.default_rng(6)
    pixels = np.kron(rng.integers(0, 256, (24, 4, 3)), np.ones((16, 16, 1))).astype(np.uint8)
    sky = spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, nchannel=3, height=384, width=64
    )
    sky.data = pixels.tobytes()
    spec.worldbody.add_geom(type=KINDS.mjGEOM_BOX, size=[0.01, 0.01, 0.01])
    model, camera = spec.compile(), Camera(160, 120, 70.0, 70.0, 79.5, 59.5)
    scene = RayScene.of_model(model)
    with gl.GlRenderer(model) as renderer:
        for k in range(3):
            T = np.eye(4)
            T[:3, :3] = Rotation.random(random_state=k).as_matrix()
            T[:3, 3] = 1.0, 2.0, 3.0
            ours = Painter(scene, model).paint(camera, T, scene.view(camera, T)).astype(int)
            assert (np.abs(ours - renderer.rgb(camera, T)).max(axis=-1) < 40).mean() > 0.95


def test_without_opengl_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gl, "PLATFORMS", {"no-such-platform": "libegl1"})
    gl.available.cache_clear()
    try:
        assert gl.available() is None
        with pytest.raises(MissingPackage, match="install libegl1, or choose"):
            gl.GlRenderer(mujoco.MjModel.from_xml_string("<mujoco/>"))
    finally:
        gl.available.cache_clear()
