from __future__ import annotations

import numpy as np
import pytest

from depthba.camera import Camera
from sim.engine import mujoco
from sim.rendering.raycast import RayScene, world_rays
from sim.rendering.shading import Finish, Lighting, Painter, colours_of
from sim.rendering.tessellate import Triangles

KINDS = mujoco.mjtGeom
EVEN = Lighting(lamp=0.0, sky=1.0, ground=1.0)
"""The same light on every side: what is seen is the texture."""


def textured(
    spec: mujoco.MjSpec, pixels: np.ndarray, cube: bool = False, **material: object
) -> str:
    """Add a texture (height, width, 3) and a material of it; the material's name."""
    kinds = mujoco.mjtTexture
    texture = spec.add_texture(
        name="image", type=kinds.mjTEXTURE_CUBE if cube else kinds.mjTEXTURE_2D, nchannel=3,
        height=pixels.shape[0], width=pixels.shape[1],
    )  # fmt: skip
    texture.data = pixels.astype(np.uint8).tobytes()
    skin = spec.add_material(name="skin", specular=0, shininess=0, **material)
    names = list(skin.textures)
    names[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "image"
    skin.textures = names
    return "skin"


def sheet(pixels: np.ndarray) -> mujoco.MjModel:
    """A sheet of 0.4 x 0.3 m in z = 0, seen from above: the image's first row along y = -0.15."""
    spec = mujoco.MjSpec()
    corners = np.array([[-0.2, -0.15, 0], [0.2, -0.15, 0], [0.2, 0.15, 0], [-0.2, 0.15, 0]])
    faces = np.array([0, 1, 2, 0, 2, 3])
    spec.add_mesh(
        name="sheet", uservert=corners.ravel(), userface=faces, userfacetexcoord=faces,
        usertexcoord=[0, 0, 1, 0, 1, 1, 0, 1], inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )  # fmt: skip
    spec.worldbody.add_geom(
        type=KINDS.mjGEOM_MESH,
        meshname="sheet",
        material=textured(spec, pixels),
        contype=0,
        conaffinity=0,
    )
    return spec.compile()


def above(height: float, tilt: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """T_world_camera that looks at the origin from a distance, tilted about x, rolled about z."""
    c, s, cr, sr = np.cos(tilt), np.sin(tilt), np.cos(roll), np.sin(roll)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, :3] = (
        np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        @ T[:3, :3]
        @ np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    )
    T[:3, 3] = -height * T[:3, 2]
    return T


def picture(
    model: mujoco.MjModel, camera: Camera, T: np.ndarray, lighting: Lighting = EVEN
) -> np.ndarray:
    scene = RayScene.of_model(model)
    return Painter(scene, model, lighting).paint(camera, T, scene.view(camera, T))


def linear(image: np.ndarray) -> np.ndarray:
    """Screen values in linear light, by IEC 61966-2-1."""
    x = image / 255.0
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def test_a_sheet_shows_the_four_corners_of_its_image() -> None:
    pixels = np.zeros((60, 80, 3), np.uint8)
    colours = np.array([[[220, 30, 30], [30, 220, 30]], [[30, 30, 220], [220, 220, 30]]])
    for row in (0, 1):
        for column in (0, 1):
            pixels[30 * row : 30 * row + 30, 40 * column : 40 * column + 40] = colours[row, column]
    camera, T = Camera(320, 240, 400.0, 400.0, 159.5, 119.5), above(0.7, 0.4, 0.3)
    image = picture(sheet(pixels), camera, T)
    for row, y in enumerate((-0.147, 0.147)):
        for column, x in enumerate((-0.197, 0.197)):
            p = np.linalg.inv(T) @ [x, y, 0, 1]
            u, v = np.round(camera.project(p[:3])).astype(int)
            seen = linear(image[v, u])
            np.testing.assert_allclose(seen, linear(colours[row, column]), atol=0.01)


@pytest.mark.parametrize("distance", [0.15, 0.4, 0.9, 2.0])
def test_the_edge_of_a_square_lies_where_the_geometry_says(distance: float) -> None:
    # From four pixels a texel down to three texels a pixel.
    pixels = np.full((300, 400, 3), 20, np.uint8)
    pixels[:, :203] = 230
    edge = 0.4 * 203 / 400 - 0.2
    model, camera = sheet(pixels), Camera(320, 240, 600.0, 600.0, 159.5, 119.5)
    scene = RayScene.of_model(model)
    painter = Painter(scene, model, EVEN)
    error = []
    for k in range(12):
        T = above(distance, 0.4, 0.03 * k)
        T[0, 3] += 0.011 * distance * k / 12
        image = linear(painter.paint(camera, T, scene.view(camera, T))[..., 0].astype(float))
        for row in (110, 120, 130):
            # Where the plane of the row's rays cuts the edge.
            toward = T[:3, :3] @ [0.0, 1.0 / camera.fy * (row - camera.cy), 1.0]
            normal = np.cross(toward, T[:3, 0])
            y = (normal @ T[:3, 3] - normal[0] * edge) / normal[1]
            u = camera.project((np.linalg.inv(T) @ [edge, y, 0.0, 1.0])[:3])[0]
            first = round(u) - 12
            row_of_edge = image[row, first : first + 24]
            bright, dark = row_of_edge[0], row_of_edge[-1]
            share = (row_of_edge - dark) / (bright - dark)
            error.append(first - 0.5 + share.sum() - u)
    assert np.abs(np.mean(error)) < 0.005
    assert np.max(np.abs(error)) < 0.02


def test_a_geoms_own_colour_wins_over_its_materials() -> None:
    spec = mujoco.MjSpec()
    spec.add_material(name="steel", rgba=[0.1, 0.2, 0.3, 1], specular=0.8, shininess=0.5)
    for change in ({}, {"rgba": [0.7, 0.6, 0.5, 1]}, {"rgba": [0.7, 0.6, 0.5, 0]}):
        spec.worldbody.add_geom(
            type=KINDS.mjGEOM_BOX, size=[0.1, 0.1, 0.1], material="steel", **change
        )
    model = spec.compile()
    np.testing.assert_allclose(
        colours_of(model), [[0.1, 0.2, 0.3], [0.7, 0.6, 0.5], [0.7, 0.6, 0.5]], atol=1e-7
    )
    finish = Finish.of_model(model)
    np.testing.assert_allclose(finish.gloss, 0.4, atol=1e-6)
    assert finish.reflectance[1] == pytest.approx(0.7 * 0.2126 + 0.6 * 0.7152 + 0.5 * 0.0722)
    assert set(RayScene.of_model(model).triangles.geom) == {0, 1}  # the third is invisible


def ball(**material: float) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.add_material(name="skin", rgba=[0.3, 0.3, 0.3, 1], **material)
    spec.worldbody.add_geom(type=KINDS.mjGEOM_SPHERE, size=[0.5, 0, 0], material="skin")
    return spec.compile()


def test_round_bodies_do_not_look_faceted_and_edges_stay_sharp() -> None:
    camera, T = Camera(200, 200, 250.0, 250.0, 99.5, 99.5), above(2.0)
    model, images = ball(specular=0, shininess=0), []
    for segments in (48, 512):
        scene = RayScene.of_model(model, segments=segments)
        image = Painter(scene, model).paint(camera, T, scene.view(camera, T))
        images.append(image[60:140, 60:140].astype(int))
    assert np.abs(images[0] - images[1]).max() <= 4
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=KINDS.mjGEOM_CYLINDER, size=[0.2, 0.1, 0])
    triangles = RayScene.of_model(spec.compile()).triangles
    upright = np.abs(np.cross(*sides(triangles)))[:, 2] > 1e-9
    np.testing.assert_array_equal(np.sort(triangles.curved), np.flatnonzero(~upright))
    np.testing.assert_allclose(triangles.corner_normals[..., 2], 0.0, atol=1e-6)


def sides(triangles: Triangles) -> tuple[np.ndarray, np.ndarray]:
    corner = triangles.vertices[triangles.faces]
    return corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]


def test_the_highlight_is_where_the_lamp_is_mirrored_and_only_on_gloss() -> None:
    camera, T = Camera(300, 300, 400.0, 400.0, 149.5, 149.5), above(2.0)
    lamp = Lighting(towards=(0.6, 0.0, 0.8), lamp=1.0, sky=0.0, ground=0.0)
    matt, shiny = (
        picture(ball(specular=s, shininess=s), camera, T, lamp)[..., 0].astype(int)
        for s in (0.0, 0.8)
    )
    extra = shiny - matt
    v, u = np.unravel_index(np.argmax(extra), extra.shape)
    scene = RayScene.of_model(ball())
    hits = scene.view(camera, T)
    half = np.array([0.6, 0.0, 0.8]) - world_rays(camera, T)[v, u]
    half /= np.linalg.norm(half)
    assert scene.normals_of(hits)[v, u] @ half > np.cos(np.radians(4.0))
    assert extra.max() > 25


def test_shadow_falls_away_from_the_lamp_and_equal_views_have_equal_bytes() -> None:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=KINDS.mjGEOM_PLANE, size=[2, 2, 0.1])
    spec.worldbody.add_geom(type=KINDS.mjGEOM_BOX, size=[0.1, 0.1, 0.2], pos=[0, 0, 0.2])
    camera, T = Camera(200, 200, 200.0, 200.0, 99.5, 99.5), above(2.0)
    lamp = Lighting(towards=(-1.0, 0.0, 1.0))
    model = spec.compile()
    image = picture(model, camera, T, lamp)
    row = image[100, :, 0].astype(int)  # x grows with u, 100 px a metre on the plane
    assert row[120] < row[60] - 30  # behind the box, 0.2 m to the right
    assert row[60] == row[180]
    np.testing.assert_array_equal(image, picture(model, camera, T, lamp))
    scene = RayScene.of_model(model)
    painter = Painter(scene, model, lamp)
    again = painter.at(scene).paint(camera, T, scene.view(camera, T))
    np.testing.assert_array_equal(image, again)
