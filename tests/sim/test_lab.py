from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.spatial import ConvexHull, cKDTree

from sim.engine import mujoco
from sim.errors import SimulationError
from sim.rendering.raycast import RayScene
from sim.rendering.tessellate import Triangles, triangles_of
from sim.scenes import lab
from sim.scenes.machined import flange, stepped_shaft
from sim.scenes.solids import Solid, circle, extrude, joined, polygon, rectangle, rounded
from sim.scenes.table import WORK_AREA
from sim.scenes.tools import TOOLS
from sim.seeds import stream

BUILDERS = {"lab-1": lab.lab_1, "lab-2": lab.lab_2, "lab-3": lab.lab_3}
SLACK = 1e-4
"""How deep things may sink into each other, or stand off, m."""


@dataclass
class Built:
    """A scene as it comes back from its text."""

    spec: mujoco.MjSpec
    xml: str
    model: mujoco.MjModel

    @cached_property
    def triangles(self) -> Triangles:
        data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, data)
        return triangles_of(self.model, data)

    @cached_property
    def body(self) -> np.ndarray:
        """Body of each triangle."""
        return np.asarray(self.model.geom_bodyid)[self.triangles.geom]

    @cached_property
    def objects(self) -> dict[str, Solid]:
        """What stands on the table, in the world's frame."""
        found = {}
        for k in range(1, self.model.nbody):
            name = self.model.body(k).name
            if not name.startswith("ur16e"):
                found[name] = self.cut(self.body == k)
        return found

    def cut(self, mask: np.ndarray) -> Solid:
        corners, index = np.unique(self.triangles.faces[mask], return_inverse=True)
        return Solid(self.triangles.vertices[corners], index.reshape(-1, 3))

    @cached_property
    def samples(self) -> dict[str, np.ndarray]:
        """Points (n, 3) of each object's surface: the corners and the middles of its triangles."""
        return {
            name: np.concatenate([solid.vertices, solid.vertices[solid.faces].mean(axis=1)])
            for name, solid in self.objects.items()
        }

    @cached_property
    def boxes(self) -> dict[str, np.ndarray]:
        """Lower and upper corner (2, 3) of each object."""
        return {
            name: np.stack([solid.vertices.min(axis=0), solid.vertices.max(axis=0)])
            for name, solid in self.objects.items()
        }

    @cached_property
    def groups(self) -> list[list[str]]:
        """Objects of one kind whose bounding boxes keep apart, so as to be looked at in one go."""
        kinds: dict[str, list[str]] = {}
        for name in self.objects:
            kinds.setdefault(name.rsplit("_", 1)[0], []).append(name)
        groups = []
        for names in kinds.values():
            low, high = np.stack([self.boxes[name] for name in names], axis=1)
            meet = ((low[:, None] <= high) & (low <= high[:, None])).all(axis=2).sum() > len(names)
            groups += [[name] for name in names] if meet else [names]
        return groups

    def within(self, names: list[str], points: np.ndarray, axes: int) -> np.ndarray:
        """Which points (n, 3) lie in the bounding boxes of objects, in the first `axes` axes."""
        found = np.zeros(len(points), bool)
        for name in names:
            low, high = self.boxes[name]
            found |= ((points >= low) & (points <= high))[:, :axes].all(axis=1)
        return found

    def rays(self, names: list[str]) -> RayScene:
        """Some objects alone."""
        solid = joined(self.objects[name] for name in names)
        return RayScene(
            Triangles(solid.vertices, solid.faces, np.zeros(len(solid.faces), np.int64))
        )

    @cached_property
    def stage(self) -> RayScene:
        """All but the arm."""
        mask = ~np.isin(self.body, [
            k for k in range(self.model.nbody) if self.model.body(k).name.startswith("ur16e")
        ])  # fmt: skip
        t = self.triangles
        return RayScene(Triangles(t.vertices, t.faces[mask], t.geom[mask]))


@pytest.fixture(scope="module")
def scenes() -> dict[str, Built]:
    built = {}
    for name, build in BUILDERS.items():
        spec = build(5)
        xml = spec.to_xml()
        built[name] = Built(spec, xml, mujoco.MjModel.from_xml_string(xml))
    return built


@pytest.fixture(params=list(BUILDERS))
def scene(request: pytest.FixtureRequest, scenes: dict[str, Built]) -> Built:
    return scenes[request.param]


def contents(spec: mujoco.MjSpec) -> list[bytes]:
    meshes = [
        np.asarray(m.uservert).tobytes() + np.asarray(m.userface).tobytes() for m in spec.meshes
    ]
    poses = [b.name.encode() + np.array([*b.pos, *b.quat]).tobytes() for b in spec.bodies]
    return [*meshes, *poses, *(np.asarray(g.rgba).tobytes() for g in spec.geoms)]


@pytest.mark.parametrize("name", BUILDERS)
def test_the_seed_alone_decides(name: str, scenes: dict[str, Built]) -> None:
    again, other = BUILDERS[name](5), BUILDERS[name](6)
    assert contents(again) == contents(scenes[name].spec)
    assert len(set(contents(other)) & set(contents(again))) < 0.5 * len(contents(again))


def test_the_text_holds_every_piece_where_it_was_put(scene: Built) -> None:
    assert len(scene.xml) < 15e6
    assert len(scene.triangles.faces) < 400_000
    meshes = {mesh.name: mesh for mesh in scene.spec.meshes}
    for body in scene.spec.bodies:
        if body.name not in scene.objects:
            continue
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, np.asarray(body.quat))
        put = np.concatenate([
            np.reshape(meshes[geom.meshname].uservert, (-1, 3)) for geom in body.geoms
        ]) @ turn.reshape(3, 3).T + body.pos  # fmt: skip
        off, _ = cKDTree(scene.objects[body.name].vertices).query(put)
        assert off.max() < 2e-6, body.name


def test_pieces_stay_in_the_work_area(scene: Built) -> None:
    assert len(scene.objects) > 30
    every = np.concatenate([solid.vertices for solid in scene.objects.values()])
    x0, x1, y0, y1 = WORK_AREA
    assert every[:, 0].min() > x0 and every[:, 0].max() < x1
    assert every[:, 1].min() > y0 and every[:, 1].max() < y1
    assert every[:, 2].min() > -SLACK and 0.08 < every[:, 2].max() < 0.2501


def test_nothing_sinks_into_anything(scene: Built) -> None:
    ways = np.concatenate([np.eye(3), -np.eye(3)])
    for names in scene.groups:
        rays = scene.rays(names)
        every = np.concatenate(
            [scene.samples[other] for other in scene.objects if other not in names]
        )
        points = every[scene.within(names, every, 3)]
        if not len(points):
            continue
        depth = np.full((len(points), 6), np.inf)
        for k, way in enumerate(ways):
            hits = rays.cast(points, np.broadcast_to(way, points.shape))
            leaves = (hits.triangle >= 0) & (rays.normals[hits.triangle] @ way > 0.0)
            depth[leaves, k] = hits.distance[leaves]
        inside = np.isfinite(depth).all(axis=1)
        assert depth[inside].min(axis=1, initial=np.inf).max(initial=0.0) < SLACK, names


def test_nothing_floats(scene: Built) -> None:
    down = np.array([0.0, 0.0, -1.0])
    for names in scene.groups:
        lowest = {name: float(scene.objects[name].vertices[:, 2].min()) for name in names}
        up = {name for name, z in lowest.items() if z > SLACK}
        if not up:
            continue
        low, high = np.stack([scene.boxes[name] for name in names], axis=1)
        others = [
            name for name, (a, b) in scene.boxes.items()
            if name not in names and ((a <= high) & (b >= low))[:, :2].all(axis=1).any()
        ]  # fmt: skip
        below = scene.rays(others)
        points = np.concatenate([scene.objects[name].vertices for name in others])
        for name in up:
            own = scene.objects[name].vertices
            # From a hair above, so as not to start below what it touches.
            gap = below.cast(own - SLACK * down, np.broadcast_to(down, own.shape)).distance
            least = np.nanmin(gap, initial=lowest[name]) - SLACK
            if least > SLACK:
                # Not by a corner of its own: by one of what is below.
                near = points[scene.within([name], points, 2)]
                mine = scene.rays([name])
                hits = mine.cast(near + SLACK * down, np.broadcast_to(-down, near.shape))
                rises = (hits.triangle >= 0) & (mine.normals[hits.triangle, 2] < 0.0)
                least = min(least, np.min(hits.distance[rises], initial=np.inf) - SLACK)
            assert least < SLACK, name


@pytest.mark.parametrize("seed", range(3))
def test_tools_come_to_lie_stably(seed: int) -> None:
    for maker in (*TOOLS, stepped_shaft):
        whole = maker(stream(seed, "tool")).solid()
        a, b, c = (whole.vertices[whole.faces[:, k]] for k in range(3))
        volume = np.einsum("ij,ij->i", np.cross(a, b), c)
        centre = (volume[:, None] * (a + b + c)).sum(axis=0) / (4.0 * volume.sum())
        assert abs(whole.vertices[:, 2].min()) < 1e-9
        contact = whole.vertices[whole.vertices[:, 2] < 1e-6, :2]
        sides = ConvexHull(contact).equations
        assert (sides[:, :2] @ centre[:2] + sides[:, 2]).max() < 1e-9, maker.__name__


def test_holes_are_exact_and_open() -> None:
    """A prism with holes is closed, has the volume it should have, and lets light through."""
    bolts = [circle(0.004, (0.045 * np.cos(a), 0.045 * np.sin(a))) for a in np.arange(6.0)]
    slot = rounded(0.01, 0.003, 0.003, (0.0, 0.028))
    shapes = [circle(0.018), slot, *bolts, polygon(0.002, 6, (0.0, -0.03))]
    solid = extrude(circle(0.06), 0.012, shapes)

    def area(ring: np.ndarray) -> float:
        x, y = ring.T
        return 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())

    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->", np.cross(a, b), c) / 6.0
    wanted = 0.012 * (area(circle(0.06)) - sum(map(area, shapes)))
    assert volume == pytest.approx(wanted, rel=1e-9)
    edges = Counter(tuple(e) for k in range(3) for e in solid.faces[:, [k, (k + 1) % 3]].tolist())
    assert all(edges[(j, i)] == 1 for i, j in edges)
    with pytest.raises(SimulationError, match="holes cross or touch"):
        extrude(rectangle(0.02, 0.02), 0.01, [circle(0.008, (0.018, 0.0))])


def test_bolt_circles_are_seen_through(scenes: dict[str, Built]) -> None:
    scene = scenes["lab-1"]
    stage, model = scene.stage, scene.model
    for name in [n for n in scene.objects if n.startswith(("flange", "gear"))]:
        solid = scene.objects[name]
        low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
        x, y = np.meshgrid(np.arange(low[0], high[0], 5e-4), np.arange(low[1], high[1], 5e-4))
        origins = np.stack([x, y, np.full_like(x, high[2] + 1e-3)], axis=-1)
        hits = stage.cast(origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape))
        open_ = model.geom_bodyid[hits.geom] != model.body(name).id
        # What is open but does not reach the rim of the window is a hole.
        regions, count = label(np.pad(open_, 1, constant_values=True))
        assert count - 1 >= 5, name  # the bore and four or more around it
        inside = (regions > 1)[1:-1, 1:-1]
        z = high[2] + 1e-3 - hits.distance[inside]
        # Down to what it stands on, but for what someone may have put into the bore.
        assert np.mean(np.abs(z - low[2]) < 2e-4) > 0.9


def planar_share(scene: Built) -> float:
    """Share of the pieces' surface, undersides aside, that lies in planes over 4 cm2."""
    flat = total = 0.0
    for solid in scene.objects.values():
        a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        area = 0.5 * np.linalg.norm(normal, axis=1)
        normal /= np.maximum(2.0 * area, 1e-18)[:, None]
        keep = (normal[:, 2] > -0.5) & (area > 0.0)
        offset = np.einsum("ij,ij->i", normal, a)[:, None]
        plane = np.column_stack([normal / 0.005, offset / 0.0005]).round()[keep]
        _, which = np.unique(plane, axis=0, return_inverse=True)
        areas = np.bincount(which.ravel(), area[keep])
        flat, total = flat + areas[areas > 4e-4].sum(), total + areas.sum()
    return flat / total


def test_lab_2_has_few_planes(scenes: dict[str, Built]) -> None:
    assert planar_share(scenes["lab-1"]) > 0.4
    assert planar_share(scenes["lab-2"]) < 0.1


def test_lab_3_repeats_itself(scenes: dict[str, Built]) -> None:
    scene = scenes["lab-3"]
    model = scene.model
    places: dict[str, list[int]] = {}
    for name in scene.objects:
        places.setdefault(name.rsplit("_", 1)[0], []).append(model.body(name).id)
    many = {kind: np.array(ids) for kind, ids in places.items() if len(ids) >= 6}
    assert len(many) == 8 and sum(map(len, many.values())) > 150
    for kind, ids in many.items():
        mesh = model.geom_dataid[model.body_geomadr[ids]]
        assert len(np.unique(mesh)) == 1, kind
        apart = cKDTree(model.body_pos[ids]).query(model.body_pos[ids], k=2)[0][:, 1]
        assert np.mean(np.abs(apart - np.median(apart)) < 2e-3) > 0.9, kind


def test_every_patch_has_slopes_in_all_directions(scene: Built) -> None:
    """What a patch's surface says about x, y and yaw, seen from four sides: none is left loose."""
    x, y = np.meshgrid(np.arange(-0.6, 0.6, 0.005), np.arange(0.22, 0.85, 0.005))
    ground = np.stack([x, y, np.zeros_like(x)], axis=-1)
    points, normals = [], []
    for heading in np.arange(4) * 0.5 * np.pi + 0.4:
        tilt = np.radians(35.0)
        way = -np.array(
            [np.sin(tilt) * np.cos(heading), np.sin(tilt) * np.sin(heading), np.cos(tilt)]
        )
        hits = scene.stage.cast(ground - 0.5 * way, np.broadcast_to(way, ground.shape))
        seen = hits.triangle >= 0
        points.append((ground - 0.5 * way + hits.distance[..., None] * way)[seen])
        normals.append(scene.stage.normals[hits.triangle[seen]])
    p, n = np.concatenate(points), np.concatenate(normals)
    for cx in np.arange(-0.425, 0.43, 0.085):
        for cy in (0.395, 0.48, 0.56, 0.675):
            near = (np.abs(p[:, :2] - [cx, cy]) < 0.175).all(axis=1)
            arm = (p[near, :2] - [cx, cy]) / 0.1
            turn = arm[:, 0] * n[near, 1] - arm[:, 1] * n[near, 0]
            rows = np.column_stack([n[near, :2], turn])
            assert np.linalg.eigvalsh(rows.T @ rows / near.sum()).min() > 0.015, (cx, cy)


def test_a_flange_depends_on_its_stream_only() -> None:
    one, two = (flange(stream(4, "flange")).solid() for _ in range(2))
    assert one.vertices.tobytes() == two.vertices.tobytes()
