"""What every gantry does and refuses, each driver against its moving device over a real line."""

from __future__ import annotations

import os
import signal
import threading
import time
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("pymodbus", reason="the extra rig is not installed")
pytest.importorskip("serial", reason="the extra rig is not installed")
if not hasattr(os, "openpty"):
    pytest.skip("no pseudo-terminals here", allow_module_level=True)

from rig.errors import AxesError
from tests.rig.axes_devices import Device, both, gantry
from tests.rig.peers import ends_in_time


@both
def test_homes_moves_stops_and_comes_back(device: Device) -> None:
    with gantry(device, home=False) as axes:
        assert not axes.status().homed
        with pytest.raises(AxesError, match=r"not homed.*, expected home"):
            axes.move_to([0.1, 0.1], speed=0.2)
        homed = axes.home()
        assert homed.homed
        np.testing.assert_allclose(homed.position, device.rest, atol=1e-6)
        # The second is shorter than its ramps, the third goes nowhere.
        for target in ([0.7, 0.1], [0.7, 0.1005], [0.7, 0.1005], [0.01, 0.59]):
            state = axes.move_to(target, speed=0.4)
            assert state.homed and not state.moving
            np.testing.assert_allclose(state.position, target, atol=1e-4)
            assert abs(state.stamp - time.time()) < 60
        # Another client, as after a crash.
        axes.disconnect()
        axes.disconnect()
        with pytest.raises(AxesError, match="not connected"):
            axes.status()
        axes.connect()
        if device.remembers:
            np.testing.assert_allclose(axes.position(), [0.01, 0.59], atol=1e-4)
        else:
            with pytest.raises(AxesError, match="not homed"):
                axes.move_to([0.1, 0.5], speed=0.4)
            axes.home()
        axes.move_to([0.1, 0.5], speed=0.4)


@both
def test_moves_in_a_straight_line_and_brakes_when_told(device: Device) -> None:
    with gantry(device, fast=False) as axes:
        axes.move_to([0.01, 0.01], speed=0.4)
        seen: list[np.ndarray] = []
        told = threading.Event()

        def watch() -> None:
            while not told.is_set():
                seen.append(axes.position())
                if seen[-1][0] > 0.1:
                    axes.stop()
                    told.set()

        watcher = threading.Thread(target=watch)
        watcher.start()
        with pytest.raises(AxesError, match=r"stopped on request at x 0\.\d+ m, y"):
            axes.move_to([0.61, 0.31], speed=0.3)
        watcher.join()
        for place in seen:
            assert place[1] - 0.01 == pytest.approx((place[0] - 0.01) / 2, abs=3e-6)
        assert all(b[0] >= a[0] for a, b in pairwise(seen))
        time.sleep(0.3)  # braking from 0.3 m/s at 2 m/s^2 takes half of it
        rest = axes.status()
        assert rest.homed and not rest.moving
        assert seen[-1][0] <= rest.position[0] < 0.5
        axes.move_to([0.2, 0.1], speed=0.4)
        # With nothing to stop, the next move goes all the same.
        axes.stop()
        axes.move_to([0.1, 0.1], speed=0.4)


@both
def test_refuses_targets_before_they_leave(device: Device) -> None:
    with gantry(device) as axes:
        for target, speed, words in (
            ([np.nan, 0.1], 0.1, "axis x is nan, expected a finite"),
            ([0.1, np.inf], 0.1, "axis y is inf, expected a finite"),
            ([0.1, 0.5951], 0.1, "axis y is 0.5951 m, expected 0 m to 0.595 m"),
            ([-1e-6, 0.1], 0.1, "axis x is -1e-06 m, expected 0 m to 0.795 m"),
            ([0.1], 0.1, r"shape \(1,\), expected \(2,\): x, y"),
            (["a", "b"], 0.1, "expected 2 numbers"),
            ([0.1, 0.1], 0.0, "speed 0 m/s, expected above 0"),
            ([0.1, 0.1], 0.45, r"at most 0.4 m/s \(axis y\)"),
            ([0.1, 0.1], float("nan"), "speed nan m/s"),
        ):
            with ends_in_time(), pytest.raises(AxesError, match=words):
                axes.move_to(target, speed=speed)
        np.testing.assert_allclose(axes.position(), device.rest, atol=1e-6)


@both
@pytest.mark.parametrize("kind", ["stall", "alarm", "silent", "drop"])
def test_faults_of_a_move_end_in_one_line(
    device: Device, kind: str, capfd: pytest.CaptureFixture[str]
) -> None:
    words = {
        "stall": r"stuck: no nearer for 1 s at x 0\.[0-3]\d* m",
        "alarm": device.alarm,
        "silent": device.silence,
        "drop": "the connection was lost",
    }[kind]
    with gantry(device, "--mechanics.fault.kind", kind) as axes:
        with ends_in_time(), pytest.raises(AxesError, match=words) as caught:
            axes.move_to([0.4, 0.4], speed=0.4)
        assert "\n" not in str(caught.value)
        if kind in ("stall", "alarm"):
            state = axes.status()
            assert not state.moving and (state.alarm is not None) == (kind == "alarm")
            axes.home()
            axes.move_to([0.1, 0.1], speed=0.4)
        else:
            with ends_in_time(), pytest.raises(AxesError, match="not connected"):
                axes.status()
            axes.stop()  # never raises
    assert "pymodbus" not in capfd.readouterr().err


@both
def test_homing_that_finds_no_switch(device: Device) -> None:
    with (
        gantry(device, "--mechanics.fault.kind", "no-switch", home=False) as axes,
        ends_in_time(),
        pytest.raises(AxesError, match=device.no_switch),
    ):
        axes.home()


@both
def test_a_stop_ends_homing_and_the_reference_is_gone(device: Device) -> None:
    far = ("--mechanics.parked", "0.7", "0.5")
    with gantry(device, *far, home=False, fast=False) as axes:
        threading.Timer(0.3, axes.stop).start()
        with ends_in_time(), pytest.raises(AxesError, match="stopped on request"):
            axes.home()
        assert not axes.status().homed
        with pytest.raises(AxesError, match="not homed"):
            axes.move_to([0.1, 0.1], speed=0.1)


@both
def test_ctrl_c_brakes(device: Device) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        pytest.skip("signals come to the main thread alone")
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with gantry(device, fast=False) as axes:
            signal.setitimer(signal.ITIMER_REAL, 0.3)
            with pytest.raises(KeyboardInterrupt):
                axes.move_to([0.79, 0.59], speed=0.1)
            time.sleep(0.2)
            state = axes.status()
            assert not state.moving
            assert state.position[0] < 0.79
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
