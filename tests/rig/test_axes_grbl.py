"""The GRBL gantry against a simulated controller on a real pseudo-terminal."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("serial", reason="the extra rig is not installed")
if not hasattr(os, "openpty"):
    pytest.skip("no pseudo-terminals here", allow_module_level=True)

from rig.axes import Axes, Axis, GrblGantry, GrblOptions, Patience
from rig.axes.grbl_words import (
    HOMING,
    alarm_words,
    code_of,
    error_words,
    homing_time,
    parse_report,
)
from rig.errors import AxesError
from tests.rig.peers import ends_in_time, peer

AXES = (Axis("x", 0.0, 0.795, 0.5), Axis("y", 0.0, 0.595, 0.4))
ORIGIN = (-0.8, -0.6)
PATIENT = Patience(stall=1.0, settle=1.0)
NEAR = ("--mechanics.parked", "0.03", "0.02")
"""Close to the switches, so that homing takes little."""
FAST = (*NEAR, "--rate", "8")


@contextmanager
def gantry(*words: str, home: bool = True) -> Iterator[GrblGantry]:
    with peer("sim.axes.grbl_device", *(words or FAST)) as (_, port):
        options = GrblOptions(port, AXES, origin=ORIGIN, patience=PATIENT, reply_timeout=2.0)
        found = GrblGantry(options)
        found.connect()
        if home:
            found.home()
        try:
            yield found
        finally:
            found.disconnect()


@pytest.mark.parametrize("report", ["machine", "work"])
def test_homes_and_moves_in_the_machines_frame(report: str) -> None:
    with gantry(*FAST, "--report", report, home=False) as axes:
        _: Axes = axes
        before = axes.status()
        assert not before.homed
        assert before.alarm == "locked until it is homed"
        with pytest.raises(AxesError, match="not homed, expected home"):
            axes.move_to([0.1, 0.1], speed=0.2)
        # the switches are left by 4 mm
        np.testing.assert_allclose(axes.home().position, 0.004, atol=1e-6)
        for target in ([0.7, 0.1], [0.7, 0.1005], [0.7, 0.1005], [0.01, 0.59]):
            state = axes.move_to(target, speed=0.4)
            assert state.homed
            assert not state.moving
            np.testing.assert_allclose(state.position, target, atol=1e-4)
        # GRBL does not tell whether it is homed: who comes anew has to home
        axes.disconnect()
        axes.disconnect()
        with pytest.raises(AxesError, match="not connected"):
            axes.position()
        axes.connect()
        with pytest.raises(AxesError, match="not homed"):
            axes.move_to([0.1, 0.5], speed=0.4)


def test_moves_in_a_straight_line_and_brakes_when_told() -> None:
    with gantry(*NEAR) as axes:
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
            assert place[1] - 0.01 == pytest.approx((place[0] - 0.01) / 2, abs=2e-6)
        assert all(b[0] >= a[0] for a, b in pairwise(seen))
        rest = axes.status()
        # held first, reset only then: the position is not lost
        assert rest.homed
        assert not rest.moving
        assert seen[-1][0] <= rest.position[0] < 0.5
        time.sleep(0.1)
        np.testing.assert_array_equal(axes.position(), rest.position)
        axes.move_to([0.2, 0.1], speed=0.4)
        # with nothing to stop, the next move goes all the same
        axes.stop()
        axes.move_to([0.1, 0.1], speed=0.4)


def test_a_stop_ends_homing_and_the_reference_is_gone() -> None:
    with gantry("--rate", "0.5", home=False) as axes:
        threading.Timer(0.3, axes.stop).start()
        with ends_in_time(), pytest.raises(AxesError, match="stopped on request"):
            axes.home()
        assert not axes.status().homed
        with pytest.raises(AxesError, match="not homed"):
            axes.move_to([0.1, 0.1], speed=0.1)


def test_refuses_targets_before_they_leave() -> None:
    with gantry() as axes:
        for target, speed, words in (
            ([np.nan, 0.1], 0.1, "axis x is nan, expected a finite"),
            ([0.1, 0.6], 0.1, "axis y is 0.6 m, expected 0 m to 0.595 m"),
            ([0.1, 0.1, 0.1], 0.1, r"shape \(3,\), expected \(2,\)"),
            ([0.1, 0.1], 0.45, r"at most 0.4 m/s \(axis y\)"),
        ):
            with ends_in_time(), pytest.raises(AxesError, match=words):
                axes.move_to(target, speed=speed)
        # the controller's own limits hold where ours are wrong
        wrong = GrblGantry(replace(axes._options, axes=(Axis("x", 0, 2, 1), AXES[1])))
        axes.disconnect()
        wrong.connect()
        wrong.home()
        with ends_in_time(), pytest.raises(AxesError, match=r"soft limit: .* \(ALARM:2\)"):
            wrong.move_to([1.0, 0.1], speed=0.1)
        wrong.home()
        wrong.move_to([0.1, 0.1], speed=0.4)
        wrong.disconnect()


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("stall", r"stuck: no nearer for 1 s at x 0\.[0-3]\d* m"),
        ("alarm", r"hard limit: a switch was hit, the position is lost \(ALARM:1\), at x 0\.2"),
        ("silent", "no status report within 2 s"),
        ("drop", "the connection was lost"),
    ],
)
def test_faults_of_a_move_end_in_one_line(kind: str, words: str) -> None:
    with gantry(*FAST, "--mechanics.fault.kind", kind) as axes:
        with ends_in_time(), pytest.raises(AxesError, match=words) as caught:
            axes.move_to([0.4, 0.4], speed=0.4)
        assert "\n" not in str(caught.value)
        if kind in ("stall", "alarm"):
            state = axes.status()
            assert state.homed == (kind == "stall")
            assert (state.alarm is not None and "hard limit" in state.alarm) == (kind == "alarm")
            axes.home()
            axes.move_to([0.1, 0.1], speed=0.4)
        else:
            with ends_in_time(), pytest.raises(AxesError, match="not connected"):
                axes.status()
            axes.stop()  # never raises


def test_homing_that_finds_no_switch() -> None:
    with (
        gantry(*FAST, "--mechanics.fault.kind", "no-switch", home=False) as axes,
        ends_in_time(),
        pytest.raises(AxesError, match=r"no switch found \(ALARM:9\)"),
    ):
        axes.home()


def test_homing_that_stays_silent_ends_by_the_controllers_own_settings() -> None:
    mechanics = ("--mechanics.upper", "0.2", "0.1", "--mechanics.homing-speed", "2")
    words = (*mechanics, "--mechanics.creep-speed", "0.5", "--mute-homing")
    axes = (Axis("x", 0.0, 0.195, 0.5), Axis("y", 0.0, 0.095, 0.4))
    with peer("sim.axes.grbl_device", *words) as (_, port):
        found = GrblGantry(GrblOptions(port, axes, origin=(-0.2, -0.1), patience=PATIENT))
        found.connect()
        said = r"homing says nothing for 3\.\d+ s, longer than its travel and speed allow, and was"
        with ends_in_time(), pytest.raises(AxesError, match=said) as caught:
            found.home()
        assert "\n" not in str(caught.value)
        # It was reset: who connects anew finds no axes that still look for their switches.
        found.connect()
        state = found.status()
        assert not state.moving and state.alarm is not None
        found.disconnect()


def test_how_long_homing_may_take() -> None:
    # A metre and a half, 0.9 m, 0.2 m at 2 m/min: 1.5 times as far, then the switches anew.
    settings = {"$130": "1500.000", "$131": "900.000", "$132": "200.000"}
    settings |= {"$24": "100.000", "$25": "2000.000", "$27": "2.000"}
    assert homing_time(settings) == pytest.approx(1.2 * (1.5 * 2600 / 2000 + 0.6) * 60 + 3)
    assert homing_time({**settings, "$25": "0"}) == homing_time({}) == HOMING


def test_no_port_busy_silent_and_not_fit_for_it() -> None:
    options = GrblOptions("/dev/no-such-port", AXES, origin=ORIGIN)
    with ends_in_time(), pytest.raises(AxesError, match="cannot open the port: No such file"):
        GrblGantry(options).connect()
    ours, theirs = os.openpty()
    try:
        silent = GrblGantry(replace(options, port=os.ttyname(theirs), connect_timeout=1))
        with ends_in_time(), pytest.raises(AxesError, match="no greeting within 1 s"):
            silent.connect()
    finally:
        os.close(ours)
        os.close(theirs)
    with gantry(home=False) as first:
        second = GrblGantry(first._options)
        with ends_in_time(), pytest.raises(AxesError, match="cannot open the port") as caught:
            second.connect()
        assert "\n" not in str(caught.value)
    unfit = pytest.raises(AxesError, match=r"\$22 is 0, expected 1: homing enabled")
    with unfit, gantry("--no-homing"):
        pass
    with pytest.raises(AxesError, match="axes u, expected some of x, y, z"):
        GrblGantry(replace(options, axes=(Axis("u", 0, 1, 1),), origin=None))
    with pytest.raises(AxesError, match="origin of 2 numbers, expected 1"):
        GrblGantry(replace(options, axes=AXES[:1]))


def test_reads_what_grbl_says() -> None:
    report = parse_report("<Hold:1|MPos:1.000,-2.500,0.000|Bf:15,128|FS:500,0|WCO:0.000,1.000,0.5>")
    assert report is not None
    assert report.moving
    assert report.blocked is None
    assert report.machine is not None
    assert report.offset is not None
    np.testing.assert_array_equal(report.machine, [1, -2.5, 0])
    np.testing.assert_array_equal(report.offset, [0, 1, 0.5])
    door = parse_report("<Door:2|WPos:0,0,0>")
    assert door is not None
    assert door.blocked == "the door is open"
    for line in ("ok", "<Idle>", "<Idle|FS:0,0>", "<Idle|MPos:0,x,0>", "<Idle|MPos:0,0", ""):
        assert parse_report(line) is None
    assert code_of("ALARM:3", "ALARM") == 3
    assert code_of("[MSG:ALARM:3]", "ALARM") is None
    assert error_words(99) == "unknown error (error:99)"
    assert alarm_words(3).endswith("(ALARM:3)")
