"""The motion of simulated gantries: within its limits, to the end, and through every fault."""

from __future__ import annotations

import numpy as np
import pytest

from sim.axes.carriage import Carriage, Doing, Fault, FaultKind, Mechanics
from sim.axes.profile import braking, trapezoid


@pytest.mark.parametrize(("length", "speed"), [(0.6, 0.3), (0.01, 0.3), (1e-6, 1.0), (0.0, 0.2)])
def test_a_profile_keeps_its_limits_and_covers_its_length(length: float, speed: float) -> None:
    profile = trapezoid(length, speed, 2.0)
    times = np.linspace(0, profile.duration, 2001)
    s, v = np.array([profile.at(t) for t in times]).T
    assert s[0] == 0.0
    assert s[-1] == pytest.approx(length, abs=1e-12)
    assert profile.at(profile.duration + 5) == (pytest.approx(length, abs=1e-12), 0.0)
    assert v.max() <= speed + 1e-12
    if length > 0:
        dt = times[1]
        assert np.abs(np.diff(v)).max() <= 2.0 * dt * (1 + 1e-9)
        np.testing.assert_allclose(np.diff(s) / dt, (v[1:] + v[:-1]) / 2, atol=2.0 * dt)
        # no profile within the limits is faster: it cruises, or it is all ramps
        assert v.max() == pytest.approx(min(speed, np.sqrt(length * 2.0)), rel=1e-2)


def test_a_glimpse_from_another_thread_sees_the_same_and_changes_nothing() -> None:
    one, other = (Carriage(Mechanics(parked=(0.3, 0.1))) for _ in range(2))
    for carriage in (one, other):
        carriage.home(0.0, leave=0.004)
    for now in np.arange(0.0, 12.0, 0.137):
        assert one.doing(now) is other.doing(now)
        # A little later, while nobody has let anything happen.
        later = now + 0.01
        if other.doing(later) is one.doing(now):
            np.testing.assert_allclose(one.glimpse(later), other.position(later), atol=2e-6)
    assert one.homed
    np.testing.assert_allclose(one.glimpse(20.0), 0.004, atol=1e-6)


def test_braking_takes_the_shortest_way() -> None:
    profile = braking(0.4, 2.0)
    assert profile.duration == pytest.approx(0.2)
    assert profile.at(1.0) == (pytest.approx(0.4**2 / (2 * 2.0)), 0.0)


def homed(kind: FaultKind = "none") -> Carriage:
    carriage = Carriage(Mechanics(fault=Fault(kind)))
    carriage.home(0.0)
    assert carriage.doing(0.5) is Doing.HOMING
    assert carriage.doing(50.0) is Doing.STANDING
    return carriage


def test_homing_finds_where_the_axes_are() -> None:
    carriage = Carriage(Mechanics())
    np.testing.assert_array_equal(carriage.position(0.0), 0)  # drives count from where they woke
    np.testing.assert_array_equal(carriage.true_place(0.0), [0.31, 0.12])
    carriage = homed()
    assert carriage.homed
    np.testing.assert_allclose(carriage.true_place(50.0), 0, atol=1e-12)
    carriage.move(np.array([0.3, 0.4]), 0.25, 50.0)
    for now in (50.5, 51.0, 51.7, 60.0):
        np.testing.assert_allclose(carriage.position(now), carriage.true_place(now), atol=1e-6)
        x, y = carriage.true_place(now)
        assert y == pytest.approx(x * 4 / 3)
    np.testing.assert_allclose(carriage.position(60.0), [0.3, 0.4], atol=1e-9)
    lost = Carriage(Mechanics(fault=Fault("no-switch")))
    lost.home(0.0)
    assert lost.doing(60.0) is Doing.STANDING
    assert (lost.homed, lost.alarm) == (False, "switch")


def test_a_brake_keeps_the_reference_and_a_cut_loses_it() -> None:
    for cut in (False, True):
        carriage = homed()
        carriage.move(np.array([0.6, 0.0]), 0.3, 50.0)
        at = carriage.true_place(51.0)
        (carriage.cut if cut else carriage.brake)(51.0)
        assert carriage.doing(60.0) is Doing.STANDING
        assert carriage.homed != cut
        way = 0.0 if cut else 0.3**2 / (2 * 2.0)
        np.testing.assert_allclose(carriage.true_place(60.0), np.add(at, [way, 0]), atol=1e-9)


def test_faults_come_once_at_their_time() -> None:
    carriage = homed("stall")
    carriage.move(np.array([0.4, 0.0]), 0.2, 50.0)
    assert carriage.doing(1e4) is Doing.MOVING
    np.testing.assert_allclose(carriage.true_place(1e4), [0.2, 0], atol=1e-9)
    carriage.brake(1e4)
    assert carriage.doing(1e4 + 1) is Doing.STANDING
    carriage.move(np.array([0.4, 0.0]), 0.2, 1e4 + 1)
    assert carriage.doing(1e4 + 10) is Doing.STANDING
    np.testing.assert_allclose(carriage.position(1e4 + 10), [0.4, 0], atol=1e-6)

    carriage = homed("alarm")
    carriage.move(np.array([0.4, 0.0]), 0.2, 50.0)
    assert carriage.doing(60.0) is Doing.STANDING
    assert (carriage.alarm, carriage.homed) == ("limit", False)
