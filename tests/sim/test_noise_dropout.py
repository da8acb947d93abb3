from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim.noise import measure
from sim.noise.dropout import Dropout
from sim.noise.shot import Shot
from sim.rendering.shading import Lighting
from sim.sensors import SP1000, ZED2, DepthSensor
from tests.sim.shots import floor, narrow

SP = narrow(SP1000.resized(320, 240))
ZED = narrow(ZED2.resized(320, 180))


def share_of_holes(shot: Shot, frames: int = 4) -> float:
    exact = shot.hits.distance
    depth = [measure(exact, shot, 1, k, (Dropout(),)) for k in range(frames)]
    return float(np.isnan(depth).mean())


def lost(value: float, half: float) -> float:
    return 1.0 / (1.0 + (value / half) ** 4)


def either(*shares: float) -> float:
    return 1.0 - float(np.prod([1.0 - share for share in shares]))


@pytest.mark.parametrize("sensor", [SP, ZED], ids=lambda s: s.model)
@pytest.mark.parametrize("degrees", [0.0, 60.0, 75.0, 83.0, 86.0])
def test_grazing_views_fail(sensor: DepthSensor, degrees: float) -> None:
    shot = floor(narrow(sensor, 0.2), 2.0, tilt=(np.radians(degrees), 0.0))
    cosine = np.cos(np.radians(degrees))
    expected = either(lost(cosine, sensor.dropout_cosine), lost(cosine, sensor.dropout_return))
    assert share_of_holes(shot) == pytest.approx(expected, rel=0.05, abs=0.003)


@pytest.mark.parametrize("sensor", [SP, ZED], ids=lambda s: s.model)
@pytest.mark.parametrize("grey", [0.5, 0.05, 0.02, 0.01])
def test_dark_surfaces_fail(sensor: DepthSensor, grey: float) -> None:
    expected = either(lost(grey, sensor.dropout_return), lost(1.0, sensor.dropout_cosine))
    shot = floor(sensor, 2.0, grey=grey)
    assert share_of_holes(shot) == pytest.approx(expected, rel=0.05, abs=0.003)


@pytest.mark.parametrize("gloss", [0.1, 0.5, 0.8])
@pytest.mark.parametrize("off", [0.0, 0.06, 0.3])
def test_shiny_surfaces_fail_where_they_mirror_the_projector(gloss: float, off: float) -> None:
    """From 2 m the projector stands 0.3 / 2 rad aside: the mirror direction is half of that."""
    mirror = 0.5 * np.arctan(SP.baseline / 2.0)
    shot = floor(narrow(SP, 0.2), 2.0, tilt=(0.0, mirror + off), grey=0.6, gloss=gloss)
    cosine = np.cos(mirror + off)
    expected = either(
        lost(cosine, SP.dropout_cosine),
        lost(0.6 * (1.0 - gloss) ** 2 * cosine, SP.dropout_return),
        gloss * np.exp(-((off / SP.glare) ** 2)),
    )
    assert share_of_holes(shot) == pytest.approx(expected, rel=0.05, abs=0.003)


def test_without_a_projector_it_is_the_lamp_that_is_mirrored() -> None:
    lamp = np.array(Lighting().towards)
    half = lamp / np.linalg.norm(lamp) + [0.0, 0.0, 1.0]
    half /= np.linalg.norm(half)
    # Turned by a about x, then by b about the new y, the floor's normal is
    # (sin b, -cos b sin a, cos b cos a).
    b = np.arcsin(half[0])
    a = np.arctan2(-half[1], half[2])
    towards, away = (
        share_of_holes(floor(ZED, 2.0, tilt=(a, sign * b), grey=0.6, gloss=0.5))
        for sign in (1.0, -1.0)
    )
    assert towards == pytest.approx(0.5, abs=0.02) and away < 0.02


def test_holes_are_blotches_of_the_windows_size() -> None:
    shot = floor(narrow(ZED2), 2.0, grey=0.005)
    hole = np.isnan(measure(shot.hits.distance, shot, 1, 0, (Dropout(),)))
    kept = ~hole
    assert 0.03 < kept.mean() < 0.1
    beside = [(kept[:, lag:] & kept[:, :-lag]).mean() / kept.mean() for lag in (1, 12)]
    assert beside[0] > 0.4 and beside[1] < 2.0 * kept.mean()
    white = floor(replace(shot.sensor, window=1.0), 2.0, grey=0.005)
    assert share_of_holes(white, 1) == pytest.approx(hole.mean(), abs=0.005)
