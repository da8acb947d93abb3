"""A registration stops wherever it is when it is asked to, and leaves nothing running."""

from __future__ import annotations

import threading
import time
from collections import Counter

import numpy as np
import pytest

import depthba
from depthba.dataset import Dataset
from depthba.errors import Cancelled
from depthba.options import Options
from tests.depthba.analytic_scene import write_scene


class Button:
    """Says stop when it has been asked so many times; counts how often it was asked, and where."""

    def __init__(self, after: int | None = None) -> None:
        self.after = after
        self.asked = 0
        self.later = 0

    def __call__(self) -> bool:
        self.asked += 1
        pressed = self.after is not None and self.asked > self.after
        self.later += pressed
        return pressed


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_scene(tmp_path_factory.mktemp("cancel") / "scene", frames=3)


def test_it_stops_at_any_moment(scene: Dataset) -> None:
    whole = Button()
    before = threading.active_count()
    result = depthba.register(scene, Options(threads=2), cancel=whole)
    moments = [0, 1, whole.asked - 1]
    moments += np.random.default_rng(0).integers(0, whole.asked, 7).tolist()
    for moment in moments:
        button = Button(moment)
        with pytest.raises(Cancelled, match="was cancelled"):
            depthba.register(scene, Options(threads=2), cancel=button)
        # what was under way in the other thread may ask once more, each piece of it that waits too
        assert button.later <= 1 + 2 * 48
    end = time.monotonic() + 10
    while threading.active_count() > before and time.monotonic() < end:
        time.sleep(0.01)
    assert threading.active_count() <= before
    # and asking changes nothing
    plain = depthba.register(scene, Options(threads=2))
    np.testing.assert_array_equal(plain.T_world_camera, result.T_world_camera)


def test_every_stage_asks(scene: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a stage does between two laps of the clock is asked about within it."""
    from depthba.optimiser.clock import Clock

    stages: Counter[str] = Counter()
    button = Button()
    seen = 0
    lap = Clock.lap

    def noted(clock: Clock, stage: str) -> None:
        nonlocal seen
        stages[stage] += button.asked - seen
        seen = button.asked
        lap(clock, stage)

    monkeypatch.setattr(Clock, "lap", noted)
    depthba.register(scene, Options(threads=1), cancel=button)
    assert {"read", "prepare", "patches", "certainty", "compare with the start"} <= set(stages)
    # once a frame at least
    assert min(stages.values()) >= len(scene), stages


def test_a_frame_that_was_cancelled_can_be_given_again(scene: Dataset) -> None:
    stop = threading.Event()
    with depthba.Registration(
        scene.sensor, Options(threads=1), scene.map_frame, cancel=stop.is_set
    ) as live:
        live.add(scene[0])
        live.add(scene[1])
        stop.set()
        with pytest.raises(Cancelled):
            live.add(scene[2])
        with pytest.raises(Cancelled):
            live.result()
        stop.clear()
        assert len(live) == 2
        assert not live.add(scene[2]).held
        assert live.result().status == "converged"
