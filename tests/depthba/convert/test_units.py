"""Depth that is too large by a factor is noticed by the relief of near-flat ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from depthba import cli, se3
from depthba.camera import Camera
from depthba.convert import overlap
from depthba.convert.recording import Convention, Recording, SourceFrame
from depthba.errors import DatasetError
from depthba.trajectory import write_tum
from tests.depthba.analytic_scene import FOCAL, HEIGHT, WIDTH, Surface, bumpy, flat, ray_cast
from tests.depthba.convert import small_scene

CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=39.5, cy=29.5)
FRAMES = 8


def low(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return bumps of some 2 cm."""
    z, along_x, along_y = bumpy(x, y)
    return 0.3 * z, 0.3 * along_x, 0.3 * along_y


def level(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return 0.0 * x, 0.0 * x, 0.0 * x


def gantry(
    surface: Surface,
    factor: float = 1.0,
    noise: float = 0.003,
    step: float = 0.15,
    turn: float = 0.0,
) -> Recording:
    """Return frames taken from 1 m above, at one height, whose depth is too large by a factor.

    Args:
        surface: the ground.
        factor: by which depth is wrong.
        noise: of the poses, m and rad.
        step: between frames, m.
        turn: of the cameras, rad.

    """
    rng = np.random.default_rng(1)
    frames = []
    for k in range(FRAMES):
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, :3] = se3.exp_so3(turn * rng.uniform(-1, 1, 3)) @ T[:3, :3]
        T[:3, 3] = step * (k - 3.5), step * rng.uniform(-1, 1), 1.0
        z = factor * (ray_cast(T, surface) + rng.normal(0, 0.0005, (HEIGHT, WIDTH)))
        measured = se3.retract(T, rng.normal(0, noise, 6))
        frames.append(
            SourceFrame(f"{k}", float(k), measured, depth=lambda z=z: z, camera=CAMERA)  # type: ignore[misc]
        )
    return Recording(Path("gantry"), "depth-folder", tuple(frames), depth_scale=0.001 * factor)


@pytest.mark.parametrize("surface", [bumpy, low])
@pytest.mark.parametrize(("factor", "unit"), [(5.0, "0.001"), (10.0, "0.001"), (1000.0, "0.001")])
def test_depth_that_is_too_large_is_named_with_the_factor(
    surface: Surface, factor: float, unit: str
) -> None:
    recording = gantry(surface, factor)
    assert overlap.judge(recording).best == Convention()  # which the points alone do not tell
    with pytest.raises(DatasetError) as caught:
        overlap.check(recording)
    told = str(caught.value)
    assert f"expected --depth-scale {unit} (points 1.0" in told
    assert f" m away), or --pose-scale {factor:g} (points " in told
    assert told.endswith(" m away), or --unchecked")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("surface", [low, flat])
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("step", [0.15, 0.02, 0.0])
@pytest.mark.parametrize("turn", [0.0, 0.2])
def test_depth_in_the_right_unit_passes(
    surface: Surface, noise: float, step: float, turn: float
) -> None:
    """Also where a camera stands still, and moves by the noise of its poses alone."""
    verdict, notes = overlap.check(gantry(surface, 1.0, noise, step, turn))
    assert verdict.best == Convention() and notes


def test_without_relief_people_must_judge_by_the_distances() -> None:
    """A plane is a plane at any scale."""
    _, notes = overlap.check(gantry(level, 10.0))
    assert notes[-1].startswith("points lie about 10.") and "whose places span 1.0" in notes[-1]


def test_convert_names_the_unit_of_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = gantry(low)
    for frame in recording.frames:
        assert frame.depth is not None
        pixels = np.rint(frame.depth() / 1e-4).astype(np.uint16)
        small_scene.write_png(tmp_path / "set" / f"{frame.name}.png", pixels)
    write_tum(tmp_path / "set/poses.txt", np.arange(float(FRAMES)), recording.T_world_camera)
    words = ["convert", str(tmp_path / "set"), str(tmp_path / "out"), "--intrinsics"]
    words += ["80", "80", "39.5", "29.5", "--depth-scale"]
    assert cli.main([*words, "0.001"]) == 1
    told = capsys.readouterr().err
    assert "expected --depth-scale 0.0001 (points 1.0" in told
    assert " m away), or --pose-scale 10 (points 10." in told
    assert cli.main([*words, "0.0001"]) == 0


def far_apart(factor: float, count: int) -> Recording:
    """Return frames along a long way, in an order that is not the way's, depth off by a factor."""
    rng = np.random.default_rng(3)
    frames = []
    for k in rng.permutation(count):
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, :3] = se3.exp_so3(rng.uniform(-0.35, 0.35, 3)) @ T[:3, :3]
        T[:3, 3] = 0.12 * k, rng.uniform(-0.1, 0.1), rng.uniform(0.8, 1.2)
        z = factor * ray_cast(T, bumpy)
        frames.append(
            SourceFrame(f"{k}", float(k), T, depth=lambda z=z: z, camera=CAMERA)  # type: ignore[misc]
        )
    return Recording(Path("way"), "depth-folder", tuple(frames), depth_scale=0.001 * factor)


@pytest.mark.parametrize("count", [10, 12, 16])
def test_the_share_under_other_units_is_that_of_neighbours_by_them(count: int) -> None:
    """Else frames that are far apart are told to agree in little, and good data are doubted."""
    right = overlap.judge(far_apart(1.0, count)).share
    recording = far_apart(10.0, count)
    verdict = overlap.judge(recording)
    assert verdict.best == Convention(scale=10.0)
    assert verdict.best_share == pytest.approx(right, abs=1e-9)
    assert right > 0.5
    with pytest.raises(DatasetError) as caught:
        overlap.check(recording)
    assert "are the poses those of other frames" not in str(caught.value)
