"""A session's time goes on evenly, whatever is done to the wall clock."""

from __future__ import annotations

import time

import numpy as np
import pytest

from rig.cameras.camera import Capture, moment_of
from rig.session.steady import SteadyClock


def frame(stamp: float, moment: float | None) -> Capture:
    return Capture(np.ones((2, 2), np.float32), stamp, moment=moment)


def test_stamps_rise_whatever_the_wall_clock_does(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, stamps, wall = SteadyClock(), [], time.time
    began = wall()
    for jump in (0.0, 1e9, -1e9, 3600.0, -86400.0, 0.1, 0.0):
        monkeypatch.setattr(time, "time", lambda jump=jump: wall() + jump)
        since = clock.now()
        taken = time.time()
        stamps.append(clock.of(frame(taken, moment_of(taken))))
        assert since - 1e-3 <= stamps[-1] <= clock.now() + 1e-3
        # whom nobody has told the age finds it
        assert clock.of(frame(taken, None)) == pytest.approx(stamps[-1], abs=0.1)
    assert np.all(np.diff(stamps) > 0)
    assert stamps[0] - 1e-3 <= began + 1.0 and stamps[-1] - began < 60.0


def test_a_run_that_goes_on_comes_after_what_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = time.time
    last = wall()
    monkeypatch.setattr(time, "time", lambda: wall() - 1e9)
    clock = SteadyClock((5.0, last))
    assert last < clock.now() < last + 60.0


def test_a_camera_whose_clock_is_another_is_still_found_out() -> None:
    clock = SteadyClock()
    taken = time.time() - 7.0
    assert clock.now() - clock.of(frame(taken, moment_of(taken))) == pytest.approx(7.0, abs=0.1)
